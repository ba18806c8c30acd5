(** Slopes: how far a quantity on a box is from its value at a point, as a sum over coordinates.

    A quantity has a range, which holds its value at the point too, its value there, and slopes, such that value - value at
    the point = slopes . (z - c). Differences of functions are products with a derivative somewhere in between, so that all
    of this is first-order arithmetic: nothing is differentiated twice, and from the origin it gives Vdot = z'M z exactly. *)
From Coq Require Import Reals List ZArith Lra Lia Bool.
Require Import Vectors Spec Enclosure Forms.
Import ListNotations.
Open Scope R_scope.

Record quantity := Quantity { range : I.type; middle : I.type; slopes : list I.type }.

(** * Derivatives somewhere in between *)

Lemma mean_value (f f' : R -> R) : (forall t, derivable_pt_lim f t (f' t)) ->
  forall v w, exists t, (v <= t <= w \/ w <= t <= v) /\ f v - f w = f' t * (v - w).
Proof.
  intros h v w. destruct (Rtotal_order v w) as [l|[->|l]].
  - destruct (MVT_cor2 f f' v w l) as [t [e b]]; auto. exists t. split; [lra|]. replace (f v - f w) with (- (f w - f v)) by ring.
    rewrite e. ring.
  - exists w. split. lra. ring.
  - destruct (MVT_cor2 f f' w v l) as [t [e b]]; auto. exists t. split; [lra|]. rewrite e. ring.
Qed.

Lemma tanh_derivable t : derivable_pt_lim tanh t (1 - tanh t * tanh t).
Proof.
  assert (n : cosh t <> 0) by (unfold cosh; generalize (exp_pos t) (exp_pos (- t)); lra).
  replace (1 - tanh t * tanh t) with ((cosh t * cosh t - sinh t * sinh t) / (cosh t)²) by (unfold tanh, Rsqr; field; auto).
  apply (derivable_pt_lim_div sinh cosh t (cosh t) (sinh t)); auto.
  apply derivable_pt_lim_sinh. apply derivable_pt_lim_cosh.
Qed.

Lemma dot_neg a : forall d, dot (map Ropp a) d = - dot a d.
Proof. induction a; intros [|x d]; simpl; try ring. rewrite IHa. ring. Qed.

(** * Quantities *)

Section On.

(** z - c, and what it lies in: the box about the point, where the point lies itself. *)
Variables (d : list R) (D : list I.type).
Hypothesis d_in : enc D d.
Hypothesis zero_in_D : enc D (zeros (length d)).

Definition holds (q : quantity) (v w : R) : Prop :=
  v ∈ range q /\ w ∈ range q /\ w ∈ middle q /\ exists g, enc (slopes q) g /\ v - w = dot g d.

(** The range, cut by what the slopes say. *)
Definition tighten (q : quantity) : quantity :=
  Quantity (I.meet (range q) (add (middle q) (dotI (slopes q) D))) (middle q) (slopes q).

Lemma tighten_holds q v w : holds q v w -> holds (tighten q) v w.
Proof.
  intros (h1 & h2 & h3 & g & h4 & h5). repeat split; simpl; auto.
  - apply meet_in; auto. replace v with (w + dot g d) by lra. apply add_in; auto. now apply dot_in.
  - apply meet_in; auto. replace w with (w + dot g (zeros (length d))) by (rewrite dot_zeros; ring).
    apply add_in; auto. now apply dot_in.
  - now exists g.
Qed.

Definition constant (i : I.type) : quantity := Quantity i i [].

Lemma constant_holds i v : v ∈ i -> holds (constant i) v v.
Proof. intro h. repeat split; simpl; auto. exists []. split. constructor. simpl. ring. Qed.

Definition plusQ (p q : quantity) : quantity :=
  Quantity (add (range p) (range q)) (add (middle p) (middle q)) (plus add (slopes p) (slopes q)).

Lemma plus_holds p q v w x y : holds p v w -> holds q x y -> holds (plusQ p q) (v + x) (w + y).
Proof.
  intros (a1 & a2 & a3 & g & a4 & a5) (b1 & b2 & b3 & h & b4 & b5). repeat split; simpl; auto using add_in.
  exists (plus Rplus g h). split. now apply plus_in. rewrite dot_plus. lra.
Qed.

Definition negQ (q : quantity) : quantity := Quantity (I.neg (range q)) (I.neg (middle q)) (map I.neg (slopes q)).

Lemma neg_holds q v w : holds q v w -> holds (negQ q) (- v) (- w).
Proof.
  intros (a1 & a2 & a3 & g & a4 & a5). repeat split; simpl; auto using neg_in.
  exists (map Ropp g). split. clear - a4. induction a4; simpl; constructor; auto using neg_in.
  rewrite dot_neg. lra.
Qed.

Definition scaleQ (i : I.type) (q : quantity) : quantity :=
  Quantity (mul i (range q)) (mul i (middle q)) (map (mul i) (slopes q)).

Lemma scale_holds i k q v w : k ∈ i -> holds q v w -> holds (scaleQ i q) (k * v) (k * w).
Proof.
  intros hk (a1 & a2 & a3 & g & a4 & a5). repeat split; simpl; auto using mul_in.
  exists (map (Rmult k) g). split. now apply scale_in. rewrite dot_scale. nra.
Qed.

Definition timesQ (p q : quantity) : quantity :=
  tighten (Quantity (mul (range p) (range q)) (mul (middle p) (middle q))
    (plus add (map (mul (range q)) (slopes p)) (map (mul (middle p)) (slopes q)))).

Lemma times_holds p q v w x y : holds p v w -> holds q x y -> holds (timesQ p q) (v * x) (w * y).
Proof.
  intros (a1 & a2 & a3 & g & a4 & a5) (b1 & b2 & b3 & h & b4 & b5). apply tighten_holds.
  repeat split; simpl; auto using mul_in.
  exists (plus Rplus (map (Rmult x) g) (map (Rmult w) h)). split.
  - apply plus_in; now apply scale_in.
  - rewrite dot_plus, !dot_scale. rewrite <- a5, <- b5. ring.
Qed.

(** A function by enclosures of its values and of its derivative. *)
Definition throughQ (f f' : I.type -> I.type) (q : quantity) : quantity :=
  tighten (Quantity (f (range q)) (f (middle q)) (map (mul (f' (range q))) (slopes q))).

Lemma through_holds (f f' : I.type -> I.type) (phi phi' : R -> R) q v w :
  (forall i t, t ∈ i -> phi t ∈ f i) -> (forall i t, t ∈ i -> phi' t ∈ f' i) ->
  (forall t, derivable_pt_lim phi t (phi' t)) -> holds q v w -> holds (throughQ f f' q) (phi v) (phi w).
Proof.
  intros hf hf' hd (a1 & a2 & a3 & g & a4 & a5). apply tighten_holds. repeat split; simpl; auto.
  destruct (mean_value phi phi' hd v w) as [t [b e]].
  assert (ht : t ∈ range q) by (destruct b; [apply (between _ v w t) | apply (between _ w v t)]; auto).
  exists (map (Rmult (phi' t)) g). split. apply scale_in; auto. rewrite dot_scale, e, a5. reflexivity.
Qed.

Definition tanhQ := throughQ tanhI (fun i => sub (whole 1) (I.sqr prec (tanhI i))).
Definition sinQ := throughQ (I.sin prec) (I.cos prec).
Definition cosQ := throughQ (I.cos prec) (fun i => I.neg (I.sin prec i)).
Definition expQ := throughQ (I.exp prec) (I.exp prec).
Definition atanQ := throughQ (I.atan prec) (fun i => I.inv prec (add (whole 1) (I.sqr prec i))).
Definition powQ (k : nat) :=
  throughQ (fun i => I.power_int prec i (Z.of_nat k))
    (fun i => mul (whole (Z.of_nat k)) (I.power_int prec i (Z.of_nat (pred k)))).

Lemma tanh_holds q v w : holds q v w -> holds (tanhQ q) (tanh v) (tanh w).
Proof.
  apply (through_holds _ _ tanh (fun t => 1 - tanh t * tanh t)); intros.
  now apply tanh_in. apply sub_in. apply one_in. now apply sqr_in, tanh_in. apply tanh_derivable.
Qed.

Lemma sin_holds q v w : holds q v w -> holds (sinQ q) (sin v) (sin w).
Proof. apply (through_holds _ _ sin cos); intros; auto using sin_in, cos_in. apply derivable_pt_lim_sin. Qed.

Lemma cos_holds q v w : holds q v w -> holds (cosQ q) (cos v) (cos w).
Proof.
  apply (through_holds _ _ cos (fun t => - sin t)); intros; auto using cos_in, neg_in, sin_in. apply derivable_pt_lim_cos.
Qed.

Lemma exp_holds q v w : holds q v w -> holds (expQ q) (exp v) (exp w).
Proof. apply (through_holds _ _ exp exp); intros; auto using exp_in. apply derivable_pt_lim_exp. Qed.

Lemma atan_holds q v w : holds q v w -> holds (atanQ q) (atan v) (atan w).
Proof.
  apply (through_holds _ _ atan (fun t => / (1 + t * t))); intros; auto using atan_in.
  - apply inv_in. nra. apply add_in. apply one_in. now apply sqr_in.
  - replace (t * t) with (t ^ 2) by ring. apply derivable_pt_lim_atan.
Qed.

Lemma pow_holds k q v w : holds q v w -> holds (powQ k q) (v ^ k) (w ^ k).
Proof.
  apply (through_holds _ _ (fun t => t ^ k) (fun t => INR k * t ^ pred k)); intros; auto using pow_in.
  - apply mul_in. rewrite INR_IZR_INZ. apply whole_in. now apply pow_in.
  - apply derivable_pt_lim_pow.
Qed.

(** 1/v - 1/w = -(v - w)/(v w), where the range does not hold 0. *)
Definition invQ (q : quantity) : quantity :=
  tighten (Quantity (I.inv prec (range q)) (I.inv prec (middle q))
    (map (mul (I.neg (mul (I.inv prec (range q)) (I.inv prec (middle q))))) (slopes q))).

Lemma inv_holds q v w : nonzeroI (range q) = true -> holds q v w -> v <> 0 /\ holds (invQ q) (/ v) (/ w).
Proof.
  intros n (a1 & a2 & a3 & g & a4 & a5). generalize (nonzero_sound _ _ n a1) (nonzero_sound _ _ n a2). intros nv nw.
  split; auto. apply tighten_holds. repeat split; simpl; auto using inv_in.
  exists (map (Rmult (- (/ v * / w))) g). split.
  - apply scale_in; auto. apply neg_in, mul_in; apply inv_in; auto.
  - rewrite dot_scale, <- a5. field. auto.
Qed.

(** sqrt v - sqrt w = (v - w)/(sqrt v + sqrt w), where the range is positive. *)
Definition sqrtQ (q : quantity) : quantity :=
  tighten (Quantity (I.sqrt prec (range q)) (I.sqrt prec (middle q))
    (map (mul (I.inv prec (add (I.sqrt prec (range q)) (I.sqrt prec (middle q))))) (slopes q))).

Lemma sqrt_holds q v w : positiveI (range q) = true -> holds q v w -> 0 < v /\ holds (sqrtQ q) (sqrt v) (sqrt w).
Proof.
  intros n (a1 & a2 & a3 & g & a4 & a5). generalize (positive_sound _ _ n a1) (positive_sound _ _ n a2). intros nv nw.
  split; auto. apply tighten_holds.
  assert (0 <= v) by lra. assert (0 <= w) by lra. repeat split; simpl; auto using sqrt_in.
  generalize (sqrt_lt_R0 _ nv) (sqrt_lt_R0 _ nw). intros pv pw.
  exists (map (Rmult (/ (sqrt v + sqrt w))) g). split.
  - apply scale_in; auto. apply inv_in. lra. apply add_in; apply sqrt_in; auto.
  - rewrite dot_scale, <- a5. replace (v - w) with ((sqrt v - sqrt w) * (sqrt v + sqrt w)).
    field. lra. generalize (sqrt_sqrt v H) (sqrt_sqrt w H0). nra.
Qed.

(** * The plant *)

Definition bind {A B} (o : option A) (f : A -> option B) : option B := match o with Some a => f a | None => None end.

(** The expression on the box, if it is defined on all of it. *)
Fixpoint valueQ (x u : list quantity) (e : expr) : option quantity :=
  match e with
  | State i => nth_error x i
  | Input j => nth_error u j
  | Const q => Some (constant (ratioI q))
  | Add a b => bind (valueQ x u a) (fun p => bind (valueQ x u b) (fun q => Some (tighten (plusQ p q))))
  | Mul a b => bind (valueQ x u a) (fun p => bind (valueQ x u b) (fun q => Some (timesQ p q)))
  | Neg a => bind (valueQ x u a) (fun p => Some (negQ p))
  | Inv a => bind (valueQ x u a) (fun p => if nonzeroI (range p) then Some (invQ p) else None)
  | Sqrt a => bind (valueQ x u a) (fun p => if positiveI (range p) then Some (sqrtQ p) else None)
  | Pow a k => bind (valueQ x u a) (fun p => Some (powQ k p))
  | Sin a => bind (valueQ x u a) (fun p => Some (sinQ p))
  | Cos a => bind (valueQ x u a) (fun p => Some (cosQ p))
  | Tanh a => bind (valueQ x u a) (fun p => Some (tanhQ p))
  | Exp a => bind (valueQ x u a) (fun p => Some (expQ p))
  | Atan a => bind (valueQ x u a) (fun p => Some (atanQ p))
  end.

Inductive all_hold : list quantity -> list R -> list R -> Prop :=
  | none_hold : all_hold [] [] []
  | more_hold q v w qs vs ws : holds q v w -> all_hold qs vs ws -> all_hold (q :: qs) (v :: vs) (w :: ws).

Lemma all_nth qs vs ws : all_hold qs vs ws -> forall k q, nth_error qs k = Some q ->
  (k < length vs)%nat /\ holds q (nth k vs 0) (nth k ws 0).
Proof.
  induction 1; intros [|k] p h; simpl in *; try discriminate.
  - injection h as <-. split; auto. lia.
  - destruct (IHall_hold _ _ h). split; auto. lia.
Qed.

Lemma value_holds xq uq x u y s e : all_hold xq x y -> all_hold uq u s ->
  forall q, valueQ xq uq e = Some q -> defined x u e /\ holds q (value x u e) (value y s e).
Proof.
  intros hx hu. induction e; intros r h; simpl in *.
  - exact (all_nth _ _ _ hx _ _ h).
  - exact (all_nth _ _ _ hu _ _ h).
  - injection h as <-. split; auto. apply constant_holds, ratio_in.
  - destruct (valueQ xq uq e1) as [p|]; [|discriminate]. destruct (valueQ xq uq e2) as [q|]; [|discriminate].
    destruct (IHe1 _ eq_refl), (IHe2 _ eq_refl). injection h as <-. split; auto. now apply tighten_holds, plus_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). injection h as <-. split; auto. now apply neg_holds.
  - destruct (valueQ xq uq e1) as [p|]; [|discriminate]. destruct (valueQ xq uq e2) as [q|]; [|discriminate].
    destruct (IHe1 _ eq_refl), (IHe2 _ eq_refl). injection h as <-. split; auto. now apply times_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). simpl in h.
    destruct (nonzeroI (range p)) eqn:n; [|discriminate]. injection h as <-. destruct (inv_holds _ _ _ n H0); auto.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). injection h as <-. split; auto. now apply pow_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). injection h as <-. split; auto. now apply sin_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). injection h as <-. split; auto. now apply cos_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). injection h as <-. split; auto. now apply tanh_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). injection h as <-. split; auto. now apply exp_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). injection h as <-. split; auto. now apply atan_holds.
  - destruct (valueQ xq uq e) as [p|]; [|discriminate]. destruct (IHe _ eq_refl). simpl in h.
    destruct (positiveI (range p)) eqn:n; [|discriminate]. injection h as <-. destruct (sqrt_holds _ _ _ n H0); auto.
Qed.

End On.
