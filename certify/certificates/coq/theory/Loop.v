(** The closed loop on a box: policy, plant and V as quantities. *)
From Coq Require Import Reals List ZArith Lra Lia Bool.
Require Import Vectors Spec Enclosure Forms Slopes.
Import ListNotations.
Open Scope R_scope.

(** * What is computed once for all boxes *)

Definition layerI : Type := list (list I.type * I.type).
Definition layersI (ls : list layer) : list layerI :=
  map (map (fun row => (map dyadicI (fst row), dyadicI (snd row)))) ls.

Record channelI := ChannelI { scaleI : I.type; offsetI : I.type; restI : I.type; betaI : I.type }.

(** artanh((u_eq - offset) / scale), the input of tanh at which the input is at rest. *)
Definition shareI (ch : channel) : I.type := I.div prec (sub (ratioI (rest ch)) (dyadicI (offset ch))) (dyadicI (scale ch)).
Definition artanhI (y : I.type) : I.type :=
  I.div prec (I.ln prec (I.div prec (add (whole 1) y) (sub (whole 1) y))) (whole 2).
Definition prepared (ch : channel) : channelI :=
  ChannelI (dyadicI (scale ch)) (dyadicI (offset ch)) (ratioI (rest ch)) (artanhI (shareI ch)).

(** That its rest is what tanh can reach, which only centring before tanh asks for. *)
Definition reachable (ch : channel) : bool :=
  nonzeroI (dyadicI (scale ch)) && (positiveI (add (whole 1) (shareI ch)) && positiveI (sub (whole 1) (shareI ch))).
Definition channel_fits (s : squashing) (k : centring) (ch : channel) : bool :=
  match k, s with
  | AtPreactivation, ByTanh => reachable ch
  | AtPreactivation, ByIdentity => false
  | _, _ => true
  end.

Definition share (ch : channel) : R := (ratio (rest ch) - real (offset ch)) / real (scale ch).

Lemma reachable_sound ch : reachable ch = true ->
  real (scale ch) <> 0 /\ -1 < share ch < 1 /\ artanh (share ch) ∈ artanhI (shareI ch).
Proof.
  unfold reachable. rewrite !andb_true_iff. intros (h0 & h1 & h2).
  generalize (nonzero_sound _ _ h0 (dyadic_in _)). intro n.
  assert (e : share ch ∈ shareI ch) by (apply div_in; [exact n | apply sub_in; [apply ratio_in | apply dyadic_in] | apply dyadic_in]).
  assert (e1 : 1 + share ch ∈ add (whole 1) (shareI ch)) by (apply add_in; auto; apply one_in).
  assert (e2 : 1 - share ch ∈ sub (whole 1) (shareI ch)) by (apply sub_in; auto; apply one_in).
  generalize (positive_sound _ _ h1 e1) (positive_sound _ _ h2 e2). intros p1 p2. split; auto. split. lra.
  unfold artanh, artanhI. apply div_in. lra. 2: apply (whole_in 2).
  apply ln_in. now apply Rdiv_lt_0_compat. apply div_in; auto. lra.
Qed.

(** * On a box *)

Section On.

Variables (d : list R) (D : list I.type).
Hypothesis d_in : enc D d.
Hypothesis zero_in_D : enc D (zeros (length d)).

Notation holds := (holds d).
Notation all_hold := (all_hold d).

Fixpoint sumQ (w : list I.type) (qs : list quantity) : quantity :=
  match w, qs with
  | i :: w, q :: qs => plusQ (scaleQ i q) (sumQ w qs)
  | _, _ => constant (whole 0)
  end.

Lemma sum_holds w qs v y : all_hold qs v y -> forall W, enc w W -> holds (sumQ w qs) (dot W v) (dot W y).
Proof.
  intro h. revert w. induction h as [|q v w qs vs ws h0 h IH]; intros a W k; inversion k; subst; simpl;
    try (apply constant_holds, zero_in).
  apply plus_holds; auto. now apply scale_holds.
Qed.

Definition rowQ (row : list I.type * I.type) (qs : list quantity) : quantity :=
  tighten D (plusQ (sumQ (fst row) qs) (constant (snd row))).
Definition affineQ (l : layerI) (qs : list quantity) : list quantity := map (fun row => rowQ row qs) l.

Lemma affine_holds l qs v y : all_hold qs v y ->
  all_hold (affineQ (map (fun row => (map dyadicI (fst row), dyadicI (snd row))) l) qs) (affine l v) (affine l y).
Proof.
  intro h. induction l as [|[w b] l IH]; simpl; constructor; auto.
  apply tighten_holds; auto. apply plus_holds. apply sum_holds; auto. apply map_in, dyadic_in.
  apply constant_holds, dyadic_in.
Qed.

Lemma map_tanh_holds qs v y : all_hold qs v y -> all_hold (map (tanhQ D) qs) (map tanh v) (map tanh y).
Proof. induction 1; simpl; constructor; auto. now apply tanh_holds. Qed.

Fixpoint netQ (ls : list layerI) (qs : list quantity) : list quantity :=
  match ls with
  | [] => qs
  | [l] => affineQ l qs
  | l :: ls => netQ ls (map (tanhQ D) (affineQ l qs))
  end.

Lemma net_holds ls : forall qs v y, all_hold qs v y -> all_hold (netQ (layersI ls) qs) (net ls v) (net ls y).
Proof.
  induction ls as [|l [|l' ls] IH]; intros qs v y h.
  - exact h.
  - now apply affine_holds.
  - apply IH, map_tanh_holds, affine_holds, h.
Qed.

Definition squashQ (s : squashing) (q : quantity) : quantity := match s with ByTanh => tanhQ D q | ByIdentity => q end.
Definition squashI (s : squashing) (i : I.type) : I.type := match s with ByTanh => tanhI i | ByIdentity => i end.

Lemma squash_holds s q v w : holds q v w -> holds (squashQ s q) (squash s v) (squash s w).
Proof. destruct s; simpl; auto. now apply tanh_holds. Qed.

Lemma squash_in s i v : v ∈ i -> squash s v ∈ squashI s i.
Proof. destruct s; simpl; auto. apply tanh_in. Qed.

Definition actQ (s : squashing) (k : centring) (ch : channelI) (v : quantity) (w : I.type) : quantity :=
  tighten D
  match k with
  | AtOutput => plusQ (scaleQ (scaleI ch) (squashQ s v)) (constant (sub (restI ch) (mul (scaleI ch) (squashI s w))))
  | AtPreactivation => plusQ (scaleQ (scaleI ch) (squashQ s (tighten D (plusQ v (constant (sub (betaI ch) w)))))) (constant (offsetI ch))
  | NotCentred => plusQ (scaleQ (scaleI ch) (squashQ s v)) (constant (offsetI ch))
  end.

Lemma act_holds s k ch q v y W w : channel_fits s k ch = true -> holds q v y -> w ∈ W ->
  holds (actQ s k (prepared ch) q W) (act s k ch v w) (act s k ch y w).
Proof.
  intros f h hw. apply tighten_holds; auto. destruct k; simpl.
  - replace (real (scale ch) * squash s v - real (scale ch) * squash s w + ratio (rest ch))
      with (real (scale ch) * squash s v + (ratio (rest ch) - real (scale ch) * squash s w)) by ring.
    replace (real (scale ch) * squash s y - real (scale ch) * squash s w + ratio (rest ch))
      with (real (scale ch) * squash s y + (ratio (rest ch) - real (scale ch) * squash s w)) by ring.
    apply plus_holds. apply scale_holds. apply dyadic_in. now apply squash_holds.
    apply constant_holds, sub_in. apply ratio_in. apply mul_in. apply dyadic_in. now apply squash_in.
  - simpl in f. destruct s; [|discriminate]. destruct (reachable_sound _ f) as (_ & _ & a). unfold share in a.
    apply plus_holds; [|apply constant_holds, dyadic_in]. apply scale_holds. apply dyadic_in.
    apply squash_holds. apply tighten_holds; auto.
    set (b := artanh _) in *.
    replace (v - w + b) with (v + (b - w)) by ring. replace (y - w + b) with (y + (b - w)) by ring.
    apply plus_holds; auto. apply constant_holds. now apply sub_in.
  - apply plus_holds; [|apply constant_holds, dyadic_in]. apply scale_holds. apply dyadic_in. now apply squash_holds.
Qed.

Fixpoint actsQ (s : squashing) (k : centring) (cs : list channelI) (v : list quantity) (w : list I.type) : list quantity :=
  match cs, v, w with
  | c :: cs, p :: v, q :: w => actQ s k c p q :: actsQ s k cs v w
  | _, _, _ => []
  end.

Lemma acts_hold s k cs : forallb (channel_fits s k) cs = true ->
  forall qs v y W w, all_hold qs v y -> enc W w ->
  all_hold (actsQ s k (map prepared cs) qs W) (acts s k cs v w) (acts s k cs y w).
Proof.
  induction cs as [|ch cs IH]; intros f qs v y W w h hw; simpl. constructor.
  simpl in f. apply andb_prop in f. destruct f as [f0 f].
  destruct h as [|q p r qs vs ws h0 h]; [constructor|]. destruct hw as [|i z W w hz hw]; [constructor|].
  constructor. now apply act_holds. now apply IH.
Qed.

Fixpoint dotQ (a b : list quantity) : quantity :=
  match a, b with
  | p :: a, q :: b => plusQ (timesQ D p q) (dotQ a b)
  | _, _ => constant (whole 0)
  end.

Lemma dot_holds a b v w x y : all_hold a v w -> all_hold b x y -> holds (dotQ a b) (dot v x) (dot w y).
Proof.
  intro h. revert b x y. induction h; intros b x y k; inversion k; subst; simpl; try apply constant_holds, zero_in.
  apply plus_holds; auto. now apply times_holds.
Qed.

Fixpoint valuesQ (x u : list quantity) (es : list expr) : option (list quantity) :=
  match es with
  | [] => Some []
  | e :: es => bind (valueQ D x u e) (fun q => bind (valuesQ x u es) (fun qs => Some (q :: qs)))
  end.

Lemma values_hold xq uq x u y s : all_hold xq x y -> all_hold uq u s -> forall es fq, valuesQ xq uq es = Some fq ->
  Forall (defined x u) es /\ all_hold fq (map (value x u) es) (map (value y s) es).
Proof.
  intros hx hu. induction es as [|e es IH]; intros fq h; simpl in h.
  - injection h as <-. split; constructor.
  - destruct (valueQ D xq uq e) as [q|] eqn:he; [|discriminate]. simpl in h.
    destruct (valuesQ xq uq es) as [qs|]; [|discriminate]. injection h as <-.
    destruct (IH _ eq_refl). destruct (value_holds _ _ d_in zero_in_D _ _ _ _ _ _ _ hx hu _ he).
    split; constructor; auto.
Qed.

End On.

(** * Coordinates *)

(** The box of z, the point c in it, and what z - c lies in. *)
Record box := Box { at_all : list I.type; at_point : list I.type; apart : list I.type }.

Definition minus (z c : list R) : list R := zip Rminus z c.

(** That a box is one about these. *)
Definition about (b : box) (z c : list R) : Prop :=
  enc (at_all b) z /\ enc (at_all b) c /\ enc (at_point b) c /\ enc (apart b) (minus z c)
  /\ enc (apart b) (zeros (length (minus z c))) /\ length z = length c.

Definition linearQ (b : box) (a : list I.type) : quantity :=
  tighten (apart b) (Quantity (dotI a (at_all b)) (dotI a (at_point b)) a).

Lemma dot_minus a : forall z c, length z = length c -> dot a (minus z c) = dot a z - dot a c.
Proof.
  induction a as [|p a IH]; intros [|q z] [|r c] h; simpl in *; try discriminate; try ring.
  unfold minus in IH. rewrite IH; auto. ring.
Qed.

Lemma linear_holds b z c a A : about b z c -> enc a A -> holds (minus z c) (linearQ b a) (dot A z) (dot A c).
Proof.
  intros (h1 & h2 & h3 & h4 & h5 & h6) ha. apply tighten_holds; auto. repeat split; simpl; try now apply dot_in.
  exists A. split; auto. now rewrite dot_minus.
Qed.

Definition linearsQ (b : box) (M : list (list I.type)) : list quantity := map (linearQ b) M.

Lemma linears_hold b z c M X : about b z c -> encs M X -> all_hold (minus z c) (linearsQ b M) (apply X z) (apply X c).
Proof. intros h k; induction k; simpl; constructor; auto. now apply linear_holds. Qed.

(** The coordinates themselves, from the k-th on. *)
Fixpoint coordinatesQ (k : nat) (Z C : list I.type) : list quantity :=
  match Z, C with
  | z :: Z, c :: C => Quantity z c (repeat (whole 0) k ++ [whole 1]) :: coordinatesQ (S k) Z C
  | _, _ => []
  end.

Lemma dot_unit k : forall d, dot (repeat 0 k ++ [1]) d = nth k d 0.
Proof. induction k; intros [|x d]; simpl; try ring. rewrite IHk. ring. Qed.

Lemma unit_in k : enc (repeat (whole 0) k ++ [whole 1]) (repeat 0 k ++ [1]).
Proof. apply Forall2_app. apply repeat_in, zero_in. constructor. apply one_in. constructor. Qed.

Lemma coordinates_hold d Z C z c : enc Z z -> enc Z c -> enc C c ->
  forall k, (forall j, (j < length z)%nat -> nth (k + j) d 0 = nth j z 0 - nth j c 0) ->
  all_hold d (coordinatesQ k Z C) z c.
Proof.
  intros hz. revert C c. induction hz as [|I0 z0 Z z h0 hz IH]; intros C c h1 h2 k h; inversion h1; subst.
  constructor. inversion h2; subst. simpl. constructor.
  - repeat split; simpl; auto. exists (repeat 0 k ++ [1]). split. apply unit_in.
    rewrite dot_unit. generalize (h 0%nat). rewrite Nat.add_0_r. simpl. intro g. rewrite g. reflexivity. lia.
  - apply IH; auto. intros j hj. generalize (h (S j)). simpl. rewrite Nat.add_succ_r. intro g. apply g. lia.
Qed.

Lemma nth_minus z : forall c j, length z = length c -> (j < length z)%nat -> nth j (minus z c) 0 = nth j z 0 - nth j c 0.
Proof.
  induction z as [|p z IH]; intros [|q c] j h k; simpl in *; try discriminate; try lia.
  destruct j; auto. apply IH; lia.
Qed.

(** z'S z on the box: its products one by one, squares as squares. *)
Fixpoint rowI (i j : nat) (z : I.type) (s Z : list I.type) : I.type :=
  match s, Z with
  | p :: s, y :: Z => add (mul p (if Nat.eqb i j then I.sqr prec z else mul z y)) (rowI i (S j) z s Z)
  | _, _ => whole 0
  end.

Lemma row_in i : forall s Z j S z, enc s S -> enc Z z -> forall y Y, y ∈ Y ->
  (forall k, (j + k)%nat = i -> (k < length z)%nat -> nth k z 0 = y) -> y * dot S z ∈ rowI i j Y s Z.
Proof.
  intros s Z j S z hs. revert Z j z. induction hs as [|p P s S h0 hs IH]; intros Z j z hz y Y hy e.
  - simpl. rewrite Rmult_0_r. apply zero_in.
  - destruct hz as [|x X Z z h1 hz]; simpl. rewrite Rmult_0_r. apply zero_in.
    replace (y * (P * X + dot S z)) with (P * (y * X) + y * dot S z) by ring. apply add_in.
    + apply mul_in; auto. destruct (Nat.eqb i j) eqn:ij.
      * apply Nat.eqb_eq in ij. replace X with y. now apply sqr_in. symmetry. apply (e 0%nat). lia. simpl; lia.
      * now apply mul_in.
    + apply IH; auto. intros k hk hl. apply (e (Datatypes.S k)). lia. simpl; lia.
Qed.

Fixpoint formI (i : nat) (rest : list I.type) (M : list (list I.type)) (Z : list I.type) : I.type :=
  match rest, M with
  | z :: rest, row :: M => add (rowI i 0 z row Z) (formI (S i) rest M Z)
  | _, _ => whole 0
  end.

Lemma form_in Z z : enc Z z -> forall S X, encs S X -> forall i rest y, enc rest y ->
  (forall k, (k < length y)%nat -> (i + k < length z)%nat -> nth (i + k) z 0 = nth k y 0) ->
  dot y (apply X z) ∈ formI i rest S Z.
Proof.
  intros hz S X hs. induction hs as [|s r S X h0 hs IH]; intros i rest y hy e.
  - simpl. rewrite dot_nil_r. destruct rest; apply zero_in.
  - destruct hy as [|Y0 y0 rest y hy0 hy]; simpl. apply zero_in. apply add_in.
    + apply (row_in i s Z 0%nat r z h0 hz y0 Y0 hy0). intros k hk hl. rewrite Nat.add_0_l in hk. subst k.
      generalize (e 0%nat). rewrite Nat.add_0_r. simpl. intro g. apply g; lia.
    + apply IH; auto. intros k hk hl. generalize (e (Datatypes.S k)). rewrite Nat.add_succ_r. simpl. intro g. apply g; lia.
Qed.

(** V in coordinates, S = T'P T, as a quantity. *)
Definition formQ (b : box) (S : list (list I.type)) : quantity :=
  let q := dotQ (apart b) (coordinatesQ 0 (at_all b) (at_point b)) (linearsQ b S) in
  let natural := formI 0 (at_all b) S (at_all b) in
  tighten (apart b) (Quantity (I.meet natural (range q)) (middle q) (slopes q)).

Lemma form_holds b z c S X : about b z c -> encs S X -> holds (minus z c) (formQ b S) (form X z) (form X c).
Proof.
  intros a k. assert (a' := a). destruct a' as (h1 & h2 & h3 & h4 & h5 & h6). unfold formQ. apply tighten_holds; auto.
  assert (q : holds (minus z c) (dotQ (apart b) (coordinatesQ 0 (at_all b) (at_point b)) (linearsQ b S)) (form X z) (form X c)).
  { unfold form. apply dot_holds; auto. 2: now apply linears_hold.
    apply coordinates_hold; auto. intros j hj. simpl. now apply nth_minus. }
  destruct q as (q1 & q2 & q3 & q4). repeat split; simpl; auto; apply meet_in; auto; unfold form.
  - now apply (form_in _ z h1 S X k 0%nat).
  - now apply (form_in _ c h2 S X k 0%nat).
Qed.
