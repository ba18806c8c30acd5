(** Intervals of binary64 numbers, rounded outward, that contain real numbers; and vectors of them. *)
From Coq Require Import Reals List ZArith Lra Lia Bool.
From Coq Require Floats.
From Interval Require Import Float.Basic Float.Primitive_ops Interval.Interval Interval.Float Interval.Float_full Real.Xreal.
Require Import Vectors Spec.
Import ListNotations.
Open Scope R_scope.

Module F := PrimitiveFloat.
Module I := FloatIntervalFull F.

Definition prec : F.precision := F.PtoP 53.

Notation "x ∈ i" := (contains (I.convert i) (Xreal x)) (at level 70).

(** The real number that a float stands for; 0 for what is none. *)
Definition toR (f : PrimFloat.float) : R := proj_val (I.convert_bound f).

Arguments I.add : simpl never. Arguments I.sub : simpl never. Arguments I.mul : simpl never. Arguments I.div : simpl never.
Arguments I.neg : simpl never. Arguments I.inv : simpl never. Arguments I.exp : simpl never. Arguments I.ln : simpl never.
Arguments I.sin : simpl never. Arguments I.cos : simpl never. Arguments I.atan : simpl never. Arguments I.sqrt : simpl never.
Arguments I.sqr : simpl never. Arguments I.power_int : simpl never. Arguments I.fromZ : simpl never.
Arguments I.singleton : simpl never. Arguments I.join : simpl never. Arguments I.meet : simpl never.
Arguments I.convert : simpl never. Arguments I.sign_strict : simpl never. Arguments I.sign_large : simpl never.
Arguments I.subset : simpl never. Arguments toR : simpl never.

(** * Arithmetic *)

Definition add := I.add prec.
Definition sub := I.sub prec.
Definition mul := I.mul prec.
Definition whole (z : Z) := I.fromZ prec z.
Definition point (f : PrimFloat.float) := I.singleton f.

Arguments add : simpl never. Arguments sub : simpl never. Arguments mul : simpl never. Arguments whole : simpl never.
Arguments point : simpl never.

Lemma add_in a b x y : x ∈ a -> y ∈ b -> x + y ∈ add a b.
Proof. intros; apply (I.add_correct prec a b (Xreal x) (Xreal y)); auto. Qed.

Lemma sub_in a b x y : x ∈ a -> y ∈ b -> x - y ∈ sub a b.
Proof. intros; apply (I.sub_correct prec a b (Xreal x) (Xreal y)); auto. Qed.

Lemma mul_in a b x y : x ∈ a -> y ∈ b -> x * y ∈ mul a b.
Proof. intros; apply (I.mul_correct prec a b (Xreal x) (Xreal y)); auto. Qed.

Lemma neg_in a x : x ∈ a -> - x ∈ I.neg a.
Proof. intros; apply (I.neg_correct a (Xreal x)); auto. Qed.

Lemma sqr_in a x : x ∈ a -> x * x ∈ I.sqr prec a.
Proof. intros; apply (I.sqr_correct prec a (Xreal x)); auto. Qed.

Lemma whole_in z : IZR z ∈ whole z.
Proof. apply I.fromZ_correct. Qed.

Lemma zero_in : 0 ∈ whole 0.
Proof. apply (whole_in 0). Qed.

Lemma one_in : 1 ∈ whole 1.
Proof. apply (whole_in 1). Qed.

Lemma point_in f : toR f ∈ point f.
Proof. apply I.singleton_correct. Qed.

Lemma div_in a b x y : y <> 0 -> x ∈ a -> y ∈ b -> x / y ∈ I.div prec a b.
Proof.
  intros n h1 h2. generalize (I.div_correct prec a b (Xreal x) (Xreal y) h1 h2). simpl.
  unfold Xdiv'. rewrite is_zero_false; auto.
Qed.

Lemma inv_in a x : x <> 0 -> x ∈ a -> / x ∈ I.inv prec a.
Proof.
  intros n h. generalize (I.inv_correct prec a (Xreal x) h). simpl. unfold Xinv'. rewrite is_zero_false; auto.
Qed.

Lemma pow_in a x k : x ∈ a -> x ^ k ∈ I.power_int prec a (Z.of_nat k).
Proof.
  intro h. generalize (I.power_int_correct prec (Z.of_nat k) a (Xreal x) h).
  destruct k as [|k]; auto. cbv [Z.of_nat Xpower_int Xbind Xpower_int']. now rewrite SuccNat2Pos.id_succ.
Qed.

Lemma exp_in a x : x ∈ a -> exp x ∈ I.exp prec a.
Proof. intros; apply (I.exp_correct prec a (Xreal x)); auto. Qed.

Lemma sin_in a x : x ∈ a -> sin x ∈ I.sin prec a.
Proof. intros; apply (I.sin_correct prec a (Xreal x)); auto. Qed.

Lemma cos_in a x : x ∈ a -> cos x ∈ I.cos prec a.
Proof. intros; apply (I.cos_correct prec a (Xreal x)); auto. Qed.

Lemma atan_in a x : x ∈ a -> atan x ∈ I.atan prec a.
Proof. intros; apply (I.atan_correct prec a (Xreal x)); auto. Qed.

Lemma ln_in a x : 0 < x -> x ∈ a -> ln x ∈ I.ln prec a.
Proof.
  intros p h. generalize (I.ln_correct prec a (Xreal x) h). simpl. unfold Xln'. rewrite is_positive_true; auto.
Qed.

Lemma sqrt_in a x : 0 <= x -> x ∈ a -> sqrt x ∈ I.sqrt prec a.
Proof.
  intros p h. generalize (I.sqrt_correct prec a (Xreal x) h). simpl. auto.
Qed.

(** tanh x = 1 - 2 / (1 + exp 2x), which rises with x, so that nothing is lost on an interval. *)
Definition tanhI (a : I.type) : I.type :=
  I.sub prec (whole 1) (I.div prec (whole 2) (add (whole 1) (I.exp prec (mul (whole 2) a)))).

Lemma tanh_by_exp x : tanh x = 1 - 2 / (1 + exp (2 * x)).
Proof.
  unfold tanh, sinh, cosh. rewrite exp_Ropp. replace (2 * x) with (x + x) by ring. rewrite exp_plus.
  generalize (exp_pos x); set (e := exp x); clearbody e; intro he.
  assert (e <> 0) by lra. assert (1 + e * e <> 0) by nra. assert (e * e + 1 <> 0) by nra. field; repeat split; lra.
Qed.

Lemma tanh_in a x : x ∈ a -> tanh x ∈ tanhI a.
Proof.
  intro h. rewrite tanh_by_exp. apply sub_in. apply one_in. apply div_in.
  generalize (exp_pos (2 * x)); lra. apply (whole_in 2).
  apply add_in. apply one_in. apply exp_in, mul_in; auto. apply (whole_in 2).
Qed.

Lemma tanh_bounds x : -1 < tanh x < 1.
Proof.
  rewrite tanh_by_exp. generalize (exp_pos (2 * x)); set (e := exp (2 * x)); clearbody e; intro h.
  assert (0 < / (1 + e) < 1). { split. apply Rinv_0_lt_compat; lra. rewrite <- Rinv_1. apply Rinv_lt_contravar; lra. }
  unfold Rdiv. lra.
Qed.

Lemma tanh_zero : tanh 0 = 0.
Proof. rewrite tanh_by_exp, Rmult_0_r, exp_0. field. Qed.

Lemma tanh_of_artanh y : -1 < y < 1 -> tanh (artanh y) = y.
Proof.
  intro h. rewrite tanh_by_exp. unfold artanh.
  replace (2 * (ln ((1 + y) / (1 - y)) / 2)) with (ln ((1 + y) / (1 - y))) by field.
  rewrite exp_ln. field. split; lra. apply Rdiv_lt_0_compat; lra.
Qed.

(** * The certificate's numbers *)

Definition dyadicI (d : dyadic) : I.type :=
  match exponent d with
  | Zneg e => I.div prec (whole (mantissa d)) (whole (2 ^ Zpos e))
  | e => mul (whole (mantissa d)) (whole (2 ^ e))
  end.

Lemma two_to_the e : IZR (2 ^ Zpos e) = powerRZ 2 (Zpos e).
Proof. unfold powerRZ. rewrite pow_IZR, positive_nat_Z. reflexivity. Qed.

Lemma dyadic_in d : real d ∈ dyadicI d.
Proof.
  destruct d as [m e]. unfold real, dyadicI; simpl mantissa; simpl exponent. destruct e as [|e|e].
  - simpl powerRZ. apply mul_in; [apply whole_in | apply one_in].
  - apply mul_in. apply whole_in. rewrite <- two_to_the. apply whole_in.
  - change (powerRZ 2 (Zneg e)) with (/ powerRZ 2 (Zpos e)). apply div_in.
    + simpl powerRZ. apply pow_nonzero; lra.
    + apply whole_in.
    + rewrite <- two_to_the. apply whole_in.
Qed.

Definition ratioI (q : rational) : I.type := I.div prec (whole (numerator q)) (whole (Zpos (denominator q))).

Lemma ratio_in q : ratio q ∈ ratioI q.
Proof. apply div_in; [apply IZR_neq; discriminate | apply whole_in | apply whole_in]. Qed.

(** * Comparisons that hold for certain *)

Definition positiveI (a : I.type) : bool := match I.sign_strict a with Xgt => true | _ => false end.
Definition atleast0 (a : I.type) : bool := match I.sign_large a with Xgt | Xeq => true | _ => false end.

Lemma positive_sound a x : positiveI a = true -> x ∈ a -> 0 < x.
Proof.
  unfold positiveI. intros h k. generalize (I.sign_strict_correct a). destruct (I.sign_strict a); try discriminate.
  intro g. destruct (g _ k) as [_ q]. exact q.
Qed.

Lemma atleast0_sound a x : atleast0 a = true -> x ∈ a -> 0 <= x.
Proof.
  unfold atleast0. intros h k. generalize (I.sign_large_correct a). destruct (I.sign_large a); try discriminate; intro g.
  - generalize (g _ k). intro e. injection e as ->. lra.
  - destruct (g _ k) as [_ q]. exact q.
Qed.

Definition nonzeroI (a : I.type) : bool := positiveI a || positiveI (I.neg a).

Lemma nonzero_sound a x : nonzeroI a = true -> x ∈ a -> x <> 0.
Proof.
  unfold nonzeroI. intros h k. apply orb_prop in h. destruct h as [h|h].
  - generalize (positive_sound _ _ h k). lra.
  - generalize (positive_sound _ _ h (neg_in _ _ k)). lra.
Qed.

(** * Segments *)

Definition segment (a b : PrimFloat.float) : I.type := I.join (point a) (point b).

Lemma join_left a b x : x ∈ a -> x ∈ I.join a b.
Proof. intro. apply I.join_correct. now left. Qed.

Lemma join_right a b x : x ∈ b -> x ∈ I.join a b.
Proof. intro. apply I.join_correct. now right. Qed.

Lemma meet_in a b x : x ∈ a -> x ∈ b -> x ∈ I.meet a b.
Proof. apply I.meet_correct. Qed.

Lemma between a x y z : x ∈ a -> y ∈ a -> x <= z <= y -> z ∈ a.
Proof. intros; apply (contains_connected (I.convert a) x y); auto. Qed.

Lemma segment_in a b z : toR a <= z <= toR b -> z ∈ segment a b.
Proof. apply between; [apply join_left | apply join_right]; apply point_in. Qed.

Lemma toR_opp f : toR (F.neg f) = - toR f.
Proof.
  unfold toR, I.convert_bound. generalize (F.neg_correct f), (F.classify_correct f), (F.classify_correct (F.neg f)).
  rewrite !F.real_correct.
  destruct (F.classify f); intros h h1 h2; try (rewrite h in h2);
    destruct (F.toX f), (F.toX (F.neg f)); simpl in *; try discriminate; try lra; try (injection h as ->); lra.
Qed.

(** * Vectors *)

(** Each real number lies in the interval of its place. *)
Definition enc : list I.type -> list R -> Prop := Forall2 (fun i x => x ∈ i).

Fixpoint dotI (a b : list I.type) : I.type :=
  match a, b with
  | p :: a, q :: b => add (mul p q) (dotI a b)
  | _, _ => whole 0
  end.

Lemma dot_in a b : forall x y, enc a x -> enc b y -> dot x y ∈ dotI a b.
Proof.
  revert b. induction a as [|i a IH]; intros b x y h1 h2; inversion h1; subst; simpl. apply zero_in.
  inversion h2; subst. apply zero_in. apply add_in; auto using mul_in.
Qed.

(** Sums of lists: what one of them lacks is zero. *)
Fixpoint plus {A} (op : A -> A -> A) (a b : list A) : list A :=
  match a, b with
  | [], b => b
  | a, [] => a
  | p :: a, q :: b => op p q :: plus op a b
  end.

Lemma plus_in a : forall b x y, enc a x -> enc b y -> enc (plus add a b) (plus Rplus x y).
Proof.
  induction a as [|i a IH]; intros b x y h1 h2; inversion h1; subst; simpl; auto.
  inversion h2; subst. constructor; auto. constructor; auto using add_in. now apply IH.
Qed.

Lemma scale_in i k a x : k ∈ i -> enc a x -> enc (map (mul i) a) (map (Rmult k) x).
Proof. intro h; induction 1; simpl; constructor; auto using mul_in. Qed.

Lemma map_in {A} (f : A -> I.type) (g : A -> R) (l : list A) : (forall a, g a ∈ f a) -> enc (map f l) (map g l).
Proof. intro h; induction l; simpl; constructor; auto. Qed.

Definition encs : list (list I.type) -> list (list R) -> Prop := Forall2 enc.

Lemma map_in2 {A} (f : A -> I.type) (g : A -> R) (l : list (list A)) :
  (forall a, g a ∈ f a) -> encs (map (map f) l) (map (map g) l).
Proof. intro h; induction l; simpl; constructor; auto using map_in. Qed.

Lemma repeat_in i x n : x ∈ i -> enc (repeat i n) (repeat x n).
Proof. intro h; induction n; simpl; constructor; auto. Qed.

Lemma nth_in a x k : enc a x -> nth k x 0 ∈ nth k a (whole 0).
Proof.
  intro h; revert k; induction h; intros [|k]; simpl; try apply zero_in; auto.
Qed.

Lemma enc_length a x : enc a x -> length a = length x.
Proof. induction 1; simpl; auto. Qed.
