(** Why a `true` of `Check.check` is right. *)
From Coq Require Import Reals List ZArith QArith Qreals Bool Lra Lia.
From Coq Require Floats.
Require Import Vectors Spec Trajectories Data Enclosure Forms Slopes Loop Check.
Import ListNotations.
Close Scope Q_scope.
Open Scope R_scope.

(** * Exact numbers *)

Lemma dyadicQ_real d : Q2R (dyadicQ d) = real d.
Proof.
  destruct d as [m x]. unfold dyadicQ, real; cbv [mantissa exponent]. destruct x as [|x|x].
  - unfold Q2R, inject_Z, Qnum, Qden. rewrite mult_IZR. simpl. field.
  - unfold Q2R, inject_Z, Qnum, Qden. rewrite mult_IZR, two_to_the. field.
  - change (powerRZ 2 (Zneg x)) with (/ powerRZ 2 (Zpos x)). rewrite <- two_to_the.
    replace (2 ^ Zpos x)%Z with (Zpos (2 ^ x)) by (now rewrite Pos2Z.inj_pow). reflexivity.
Qed.

Lemma ratioQ_ratio q : Q2R (ratioQ q) = ratio q.
Proof. reflexivity. Qed.

Lemma Qeq_bool_real p q : Qeq_bool p q = true -> Q2R p = Q2R q.
Proof. intro h. apply Qeq_eqR. now apply Qeq_bool_eq. Qed.

Lemma Qle_bool_real p q : Qle_bool p q = true -> Q2R p <= Q2R q.
Proof. intro h. apply Qle_Rle. now apply Qle_bool_iff. Qed.

Lemma Q2R_zero : Q2R 0 = 0. Proof. unfold Q2R; simpl; field. Qed.
Lemma Q2R_one : Q2R 1 = 1. Proof. unfold Q2R; simpl; field. Qed.

Lemma absolute q : Q2R (Qabs.Qabs q) = Rabs (Q2R q).
Proof.
  apply Qabs.Qabs_case; intro h; apply Qle_Rle in h; rewrite Q2R_zero in h.
  - now rewrite Rabs_pos_eq.
  - now rewrite Q2R_opp, Rabs_left1.
Qed.

Lemma Q2R_red q : Q2R (Qred q) = Q2R q.
Proof. apply Qeq_eqR, Qred_correct. Qed.

Lemma Q2R_pow q k : Q2R (powerQ q k) = Q2R q ^ k.
Proof. induction k; simpl. apply Q2R_one. now rewrite Q2R_mult, IHk. Qed.

Lemma nth_zeros n k : nth k (zeros n) 0 = 0.
Proof. revert k; induction n; intros [|k]; simpl; auto. Qed.

Lemma some_inj {A} (a b : A) : Some a = Some b -> a = b.
Proof. congruence. Qed.

Lemma exact_sound n u e : forall q, exactQ u e = Some q -> value (zeros n) (map Q2R u) e = Q2R q.
Proof.
  induction e; intros r h; cbn [exactQ value] in h |- *;
    repeat match goal with
      | [ H : bind (exactQ u ?a) _ = Some _ |- _ ] =>
          let q := fresh "q" in destruct (exactQ u a) as [q|]; [cbn [bind] in H | discriminate H]; rewrite ?(IHe _ eq_refl), ?(IHe1 _ eq_refl), ?(IHe2 _ eq_refl)
      end.
  - apply some_inj in h; subst r. rewrite nth_zeros. now rewrite Q2R_zero.
  - apply some_inj in h; subst r. rewrite <- Q2R_zero at 1. apply map_nth.
  - apply some_inj in h; subst r. reflexivity.
  - apply some_inj in h; subst r. now rewrite Q2R_red, Q2R_plus.
  - apply some_inj in h; subst r. now rewrite Q2R_opp.
  - apply some_inj in h; subst r. now rewrite Q2R_red, Q2R_mult.
  - destruct (Qeq_bool q 0) eqn:z; [discriminate|]. apply some_inj in h; subst r. rewrite Q2R_red, Q2R_inv; auto.
    intro k. apply Qeq_bool_neq in z. now apply z.
  - apply some_inj in h; subst r. now rewrite Q2R_red, Q2R_pow.
  - destruct (Qeq_bool q 0) eqn:z; [|discriminate]. apply some_inj in h; subst r. rewrite (Qeq_bool_real _ _ z), Q2R_zero. apply sin_0.
  - destruct (Qeq_bool q 0) eqn:z; [|discriminate]. apply some_inj in h; subst r. rewrite (Qeq_bool_real _ _ z), Q2R_zero, Q2R_one. apply cos_0.
  - destruct (Qeq_bool q 0) eqn:z; [|discriminate]. apply some_inj in h; subst r. rewrite (Qeq_bool_real _ _ z), Q2R_zero. apply tanh_zero.
  - destruct (Qeq_bool q 0) eqn:z; [|discriminate]. apply some_inj in h; subst r. rewrite (Qeq_bool_real _ _ z), Q2R_zero, Q2R_one. apply exp_0.
  - destruct (Qeq_bool q 0) eqn:z; [|discriminate]. apply some_inj in h; subst r. rewrite (Qeq_bool_real _ _ z), Q2R_zero. apply atan_0.
  - set (s := Qmake _ _) in h. destruct (Qeq_bool (s * s) q) eqn:z; [|discriminate]. destruct (Qle_bool 0 s) eqn:w; [|discriminate].
    apply some_inj in h; subst r. rewrite <- (Qeq_bool_real _ _ z), Q2R_mult. apply sqrt_square.
    generalize (Qle_bool_real _ _ w). now rewrite Q2R_zero.
Qed.

(** * The inverse *)

Definition ratios (M : list (list rational)) : list (list R) := map (map ratio) M.

Lemma plus_Q2R a : forall b, plus Rplus (map Q2R a) (map Q2R b) = map Q2R (plus Qplus a b).
Proof.
  induction a as [|p a IH]; intros [|q b]; simpl; auto. now rewrite Q2R_plus, IH.
Qed.

Lemma combine_Q2R r : forall M, rows (map Q2R r) (map (map Q2R) M) = map Q2R (combine_rows Qplus Qmult r M).
Proof.
  unfold rows. induction r as [|p r IH]; intros [|row M]; simpl; auto. rewrite IH, <- plus_Q2R. f_equal.
  rewrite !map_map. apply map_ext. intro. now rewrite Q2R_mult.
Qed.

Lemma is_unit_sound k l : forall j, is_unit k j l = true ->
  forall x, dot (map Q2R l) x = if Nat.leb j k then (if Nat.ltb k (j + length l) then nth (k - j) x 0 else 0) else 0.
Proof.
  induction l as [|q l IH]; intros j h x.
  - simpl. rewrite Nat.add_0_r. destruct (Nat.leb j k) eqn:a; auto. destruct (Nat.ltb k j) eqn:b; auto.
    apply Nat.leb_le in a. apply Nat.ltb_lt in b. lia.
  - simpl in h. apply andb_prop in h. destruct h as [h0 h]. generalize (Qeq_bool_real _ _ h0). intro e.
    destruct x as [|y x]; simpl.
    + destruct (Nat.leb j k), (Nat.ltb k (j + S (length l))), (k - j)%nat; reflexivity.
    + rewrite e, (IH _ h). rewrite Nat.add_succ_r. destruct (Nat.eqb k j) eqn:kj.
      * apply Nat.eqb_eq in kj. subst k. rewrite Nat.leb_refl, Nat.sub_diag.
        replace (Nat.leb (S j) j) with false by (symmetry; apply Nat.leb_gt; lia).
        replace (Nat.ltb j (S (j + length l))) with true by (symmetry; apply Nat.ltb_lt; lia).
        rewrite Q2R_one. ring.
      * apply Nat.eqb_neq in kj. rewrite Q2R_zero. replace (S j + length l)%nat with (S (j + length l)) by lia.
        destruct (Nat.leb (S j) k) eqn:a.
        -- apply Nat.leb_le in a. replace (Nat.leb j k) with true by (symmetry; apply Nat.leb_le; lia).
           destruct (Nat.ltb k (S (j + length l))); [|ring]. replace (k - j)%nat with (S (k - S j)) by lia. ring.
        -- apply Nat.leb_gt in a. replace (Nat.leb j k) with false by (symmetry; apply Nat.leb_gt; lia). ring.
Qed.

Lemma inverse_sound n T W : inverse n T W = true ->
  forall x, length x = n -> apply (ratios T) (apply (ratios W) x) = x.
Proof.
  unfold inverse. rewrite andb_true_iff. intros [l h] x lx. apply Nat.eqb_eq in l. rewrite map_length in l.
  rewrite <- apply_product. apply nth_ext with 0 0.
  - unfold apply, product, ratios. rewrite !map_length. congruence.
  - intros k hk. unfold apply, product, ratios in *. rewrite !map_length in hk.
    rewrite forallb_forall in h. generalize (h k). rewrite in_seq. intro g.
    assert (kn : (0 <= k < 0 + n)%nat) by lia. specialize (g kn). apply andb_prop in g. destruct g as [g0 g].
    apply Nat.eqb_eq in g0.
    rewrite (nth_indep _ 0 (dot [] x)) by (rewrite !map_length; lia).
    rewrite (map_nth (fun row => dot row x)).
    rewrite (nth_indep _ [] (rows [] (map (map ratio) W))) by (rewrite !map_length; lia).
    rewrite (map_nth (fun r => rows r (map (map ratio) W))).
    assert (e : rows (nth k (map (map ratio) T) []) (map (map ratio) W) =
      map Q2R (combine_rows Qplus Qmult (nth k (map (map ratioQ) T) []) (map (map ratioQ) W))).
    { rewrite <- combine_Q2R. f_equal.
      - rewrite <- (map_nth (map Q2R) (map (map ratioQ) T) [] k). simpl (map Q2R []). f_equal.
        rewrite map_map. apply map_ext. intro. now rewrite map_map.
      - rewrite map_map. apply map_ext. intro. now rewrite map_map. }
    rewrite e, (is_unit_sound _ _ _ g). simpl Nat.leb. rewrite Nat.sub_0_r, Nat.add_0_l, g0.
    replace (Nat.ltb k n) with true by (symmetry; apply Nat.ltb_lt; lia). reflexivity.
Qed.

(** * Boxes *)

Lemma zip_join_left Z C z : enc Z z -> length Z = length C -> enc (zip I.join Z C) z.
Proof. intro h; revert C; induction h; intros [|i C] e; simpl in *; try discriminate; constructor; [now apply join_left | apply IHh; now injection e]. Qed.

Lemma zip_join_right Z C z : enc C z -> length Z = length C -> enc (zip I.join Z C) z.
Proof. intro h; revert Z; induction h; intros [|i Z] e; simpl in *; try discriminate; constructor; [now apply join_right | apply IHh; now injection e]. Qed.

Lemma apart_in all C z c : enc all z -> enc C c -> enc (zip (fun z c => I.join (sub z c) (whole 0)) all C) (minus z c).
Proof.
  intros h k. apply zip_in; auto. intros. apply join_left. now apply sub_in.
Qed.

Lemma apart_zero all C : forall z c, enc all z -> enc C c -> length z = length c ->
  enc (zip (fun z c => I.join (sub z c) (whole 0)) all C) (zeros (length (minus z c))).
Proof.
  revert C. induction all as [|a all IH]; intros C z c h k l; inversion h; subst; inversion k; subst; try discriminate; simpl.
  constructor. constructor. apply join_right, zero_in. apply IH; auto.
Qed.

Lemma box_about Z C z c : enc Z z -> enc C c -> length z = length c -> about (box_of Z C) z c.
Proof.
  intros h k l. assert (lz : length Z = length C) by (rewrite (enc_length _ _ h), (enc_length _ _ k); exact l).
  assert (a : enc (zip I.join Z C) z) by now apply zip_join_left.
  repeat split; simpl; auto. now apply zip_join_right. now apply apart_in. now apply apart_zero.
Qed.

Lemma within_sound Z : forall Y z, within Z Y = true -> enc Z z -> enc Y z.
Proof.
  induction Z as [|i Z IH]; intros [|j Y] z h k; simpl in h; try discriminate; inversion k; subst. constructor.
  apply andb_prop in h. destruct h as [h0 h]. constructor; [|now apply IH]. now apply (I.subset_correct i).
Qed.

Definition inbox (lo hi : list PrimFloat.float) (z : list R) : Prop :=
  Forall2 (fun a t => toR a <= t) lo z /\ Forall2 (fun b t => t <= toR b) hi z.

Lemma set_low j m l z : Forall2 (fun a t => toR a <= t) l z -> toR m <= nth j z 0 -> Forall2 (fun a t => toR a <= t) (set j m l) z.
Proof. intro h; revert j; induction h; intros [|j] k; simpl in *; constructor; auto. Qed.

Lemma set_high j m l z : Forall2 (fun b t => t <= toR b) l z -> nth j z 0 <= toR m -> Forall2 (fun b t => t <= toR b) (set j m l) z.
Proof. intro h; revert j; induction h; intros [|j] k; simpl in *; constructor; auto. Qed.

Lemma inbox_segments lo hi z : inbox lo hi z -> enc (zip segment lo hi) z.
Proof.
  intros [a b]. revert lo a. induction b as [|h t hi z h0 b IH]; intros lo a; inversion a; subst; simpl; constructor; auto.
  apply segment_in; auto. now apply IH.
Qed.

(** The point of a box that is looked at is that of its floats, whatever that is. *)
Definition middle_of (lo hi : list PrimFloat.float) : list R :=
  zip (fun a b => toR (PrimFloat.div (PrimFloat.add a b) PrimFloat.two)) lo hi.

Lemma middle_in lo : forall hi, enc (zip halfway lo hi) (middle_of lo hi).
Proof. induction lo; intros [|h hi]; simpl; constructor; auto. apply point_in. apply IHlo. Qed.

Lemma middle_length lo hi z : inbox lo hi z -> length z = length (middle_of lo hi).
Proof.
  intros [a b]. unfold middle_of. rewrite zip_length.
  - symmetry. clear - a. induction a; simpl; auto.
  - transitivity (length z). clear - a; induction a; simpl; auto. clear - b; induction b; simpl; auto.
Qed.

(** * Lists *)

Lemma forall2_nth {A B} (Q : A -> B -> Prop) (a : A) (b : B) l : forall m, length l = length m ->
  (forall k, (k < length l)%nat -> Q (nth k l a) (nth k m b)) -> Forall2 Q l m.
Proof.
  induction l as [|x l IH]; intros [|y m] e h; simpl in *; try discriminate; constructor.
  - apply (h 0%nat). lia.
  - apply IH. now injection e. intros k hk. apply (h (S k)). lia.
Qed.

Lemma squareb_sound n {A} (M : list (list A)) : squareb n M = true -> square n M.
Proof.
  unfold squareb. rewrite andb_true_iff, forallb_forall. intros [l h]. split. now apply Nat.eqb_eq.
  apply Forall_forall. intros row hr. now apply Nat.eqb_eq, h.
Qed.

Lemma square_enc n M X : encs M X -> square n M -> square n X.
Proof.
  intros h [l s]. split. rewrite <- l. symmetry. clear - h. induction h; simpl; auto.
  clear l. induction h; constructor; inversion s; subst; auto. symmetry. now apply enc_length.
Qed.

Lemma square_map n {A B} (f : A -> B) (M : list (list A)) : square n M -> square n (map (map f) M).
Proof.
  intros [l s]. split. now rewrite map_length. clear l. induction s; simpl; constructor; auto. now rewrite map_length.
Qed.

Lemma dot_scaled k M z : forall w, dot w (apply (map (map (Rmult k)) M) z) = k * dot w (apply M z).
Proof. induction M as [|row M IH]; intros [|q w]; simpl; try ring. rewrite IH, dot_scale. ring. Qed.

Lemma apply_zeros M n : apply M (zeros n) = zeros (length M).
Proof. induction M; simpl; auto. rewrite dot_zeros. unfold zeros in *. simpl. now f_equal. Qed.

Lemma minus_zeros z : forall n, n = length z -> minus z (zeros n) = z.
Proof. induction z as [|x z IH]; intros n ->; simpl; auto. unfold minus, zeros in *. simpl. rewrite IH; auto. now rewrite Rminus_0_r. Qed.

Lemma negs_in a x : enc a x -> enc (map I.neg a) (map Ropp x).
Proof. intro h; induction h; simpl; constructor; auto using neg_in. Qed.

Lemma forall2_length {A B} (Q : A -> B -> Prop) l m : Forall2 Q l m -> length l = length m.
Proof. intro h; induction h; simpl; auto. Qed.

Section Sound.

Variables (c : certificate) (rate : rational) (e : evidence).

Notation n := (states c).
Notation p := (prepare c rate e).
Notation Tr := (ratios (T e)).
Notation Wr := (ratios (W e)).
Notation Pr := (matrix c).
Notation Yr := (product Pr Tr).
Notation Sr := (congruence n Pr Tr).

Hypothesis formed : well_formed c rate e = true.

Lemma formed_all :
  length (field c) = n /\ square n (P c) /\ layers c <> [] /\ chainedb (length (channels c)) (layers c) n = true
  /\ symmetricb n (P c) = true /\ (0 < numerator rate)%Z
  /\ forallb (channel_fits (squashed c) (centred c)) (channels c) = true
  /\ forallb (rests_here c) (channels c) = true /\ unbiased c = true
  /\ forallb (fun f => is_zero (exactQ (map (fun ch => ratioQ (rest ch)) (channels c)) f)) (field c) = true
  /\ square n (T e) /\ square n (W e) /\ inverse n (T e) (W e) = true /\ length (root e) = n /\ length (core e) = n.
Proof.
  generalize formed. unfold well_formed. rewrite !andb_true_iff, !Nat.eqb_eq, Z.ltb_lt.
  intros [[[[[[[[[[[[[[h1 h2] h3] h4] h5] h6] h7] h8] h9] h10] h11] h12] h13] h14] h15].
  repeat split; auto; try (now apply squareb_sound).
  - intro k. rewrite k in h3. discriminate.
Qed.

Lemma length_field : length (field c) = n. Proof. apply formed_all. Qed.
Lemma square_P : square n (P c). Proof. apply formed_all. Qed.
Lemma square_T : square n (T e). Proof. apply formed_all. Qed.
Lemma square_W : square n (W e). Proof. apply formed_all. Qed.
Lemma length_root : length (root e) = n. Proof. apply formed_all. Qed.
Lemma length_core : length (core e) = n. Proof. apply formed_all. Qed.
Lemma rate_positive : 0 < ratio rate.
Proof.
  destruct formed_all as (_ & _ & _ & _ & _ & h & _). apply Rdiv_lt_0_compat; apply IZR_lt; auto. reflexivity.
Qed.

Lemma rows_T : Forall (fun row => length row = n) Tr.
Proof. apply (square_map n ratio (T e)), square_T. Qed.

(** * Coordinates *)

Lemma coordinates_in : encs (coordinates p) Tr.
Proof. apply map_in2, ratio_in. Qed.

Lemma gradient_in : encs (gradient p) Yr.
Proof. apply product_in. apply map_in2, dyadic_in. apply coordinates_in. Qed.

Lemma shape_in : encs (shape p) Sr.
Proof. apply product_in. apply transpose_in, coordinates_in. apply gradient_in. Qed.

Definition to_z (x : list R) : list R := apply Wr x.

Lemma from_z x : length x = n -> apply Tr (to_z x) = x.
Proof. intro h. apply (inverse_sound n); auto. apply formed_all. Qed.

Lemma length_z x : length (to_z x) = n.
Proof. unfold to_z, apply, ratios. rewrite !map_length. apply square_W. Qed.

Lemma V_form z : V c (apply Tr z) = form Sr z.
Proof. unfold V. now rewrite form_congruence; [|apply rows_T]. Qed.

Lemma at_zero : apply Tr (zeros n) = zeros n.
Proof. rewrite apply_zeros. f_equal. unfold ratios. rewrite map_length. apply square_T. Qed.

Lemma z_nonzero x : length x = n -> x <> zeros n -> to_z x <> zeros n.
Proof. intros l h k. apply h. rewrite <- (from_z x l), k. apply at_zero. Qed.

(** * The set *)

Hypothesis fits : set_fits c e p = true.

Lemma fits_all :
  positiveI (levelI p) = true /\ square n (gradient p) /\ square n (shape p) /\ definite n (shape p) = true
  /\ (forall k, (k < n)%nat -> atleast0 (point (nth k (root e) PrimFloat.zero)) = true
        /\ keeps c p (unitI c k) (point (nth k (root e) PrimFloat.zero)) = true)
  /\ (forall a lo hi, In (a, (lo, hi)) (combine (coordinates p) (domain c)) ->
        positiveI (I.neg (ratioI lo)) = true /\ positiveI (ratioI hi) = true
        /\ keeps c p a (ratioI lo) = true /\ keeps c p a (ratioI hi) = true).
Proof.
  generalize fits. unfold set_fits. rewrite !andb_true_iff, !forallb_forall.
  intros [[[[[h1 h2] h3] h4] h5] h6]. split; auto. split. now apply squareb_sound. split. now apply squareb_sound. split; auto. split.
  - intros k hk. assert (i : In k (seq 0 n)) by (apply in_seq; lia). generalize (h5 k i). cbv zeta. rewrite andb_true_iff. auto.
  - intros a lo hi i. generalize (h6 _ i). cbv beta iota. rewrite !andb_true_iff. tauto.
Qed.

Lemma level_positive : 0 < real (level c).
Proof. apply (positive_sound (levelI p)). apply fits_all. apply dyadic_in. Qed.

Lemma square_S : square n Sr.
Proof. apply (square_enc n (shape p)). apply shape_in. apply fits_all. Qed.

Lemma square_Y : square n Yr.
Proof. apply (square_enc n (gradient p)). apply gradient_in. apply fits_all. Qed.

Lemma form_positive z : length z = n -> z <> zeros n -> 0 < form Sr z.
Proof. apply (definite_sound n (shape p)). apply fits_all. apply shape_in. apply square_S. Qed.

Lemma V_positive x : length x = n -> x <> zeros n -> 0 < V c x.
Proof.
  intros l h. rewrite <- (from_z x l), V_form. apply form_positive. apply length_z. now apply z_nonzero.
Qed.

Lemma keeps_sound a A r r' : keeps c p a r = true -> enc a A -> r' ∈ r ->
  forall z, length z = n -> z <> zeros n -> real (level c) * (dot A z) ^ 2 < r' ^ 2 * form Sr z.
Proof.
  unfold keeps. rewrite andb_true_iff, Nat.eqb_eq. intros [l h] ha hr z lz nz.
  assert (lA : length A = n) by (rewrite <- (enc_length _ _ ha); exact l).
  assert (sq : square n (map (map (Rmult (r' * r'))) Sr)) by apply square_map, square_S.
  assert (g : 0 < form (less (real (level c)) (map (map (Rmult (r' * r'))) Sr) A A) z).
  { apply (definite_sound n _ _ h); auto.
    - apply less_in; auto. apply dyadic_in.
      generalize shape_in. intro k. clear - k hr. induction k; simpl; constructor; auto. apply scale_in; auto. now apply sqr_in.
    - destruct sq as [s0 s1]. split. rewrite length_less; congruence. rewrite <- lA in s1 |- *. now apply square_less. }
  unfold form in g. rewrite dot_less in g.
  - rewrite dot_scaled, (dot_comm z A) in g. unfold form. simpl. lra.
  - rewrite lA. apply sq.
  - rewrite lA. apply sq.
Qed.

Lemma keeps_inside a A r r' z : keeps c p a r = true -> enc a A -> r' ∈ r -> length z = n -> z <> zeros n ->
  form Sr z <= real (level c) -> (dot A z) ^ 2 < r' ^ 2.
Proof.
  intros h ha hr lz nz v. generalize (keeps_sound _ _ _ _ h ha hr z lz nz) level_positive. intros g l.
  assert (0 <= r' ^ 2) by (rewrite <- Rsqr_pow2; apply Rle_0_sqr).
  apply (Rmult_lt_reg_l (real (level c))); auto. nra.
Qed.

Lemma unit_list_in k : enc (unitI c k) (map (fun j => IZR (if Nat.eqb k j then 1 else 0)) (seq 0 n)).
Proof. apply map_in. intro. apply whole_in. Qed.

Lemma dot_unit_list k : forall m j z, dot (map (fun i => IZR (if Nat.eqb k i then 1 else 0)) (seq j m)) z =
  if Nat.leb j k then (if Nat.ltb k (j + m) then nth (k - j) z 0 else 0) else 0.
Proof.
  induction m as [|m IH]; intros j z.
  - simpl. rewrite Nat.add_0_r. destruct (Nat.leb j k) eqn:a; auto. destruct (Nat.ltb k j) eqn:b; auto.
    apply Nat.leb_le in a. apply Nat.ltb_lt in b. lia.
  - destruct z as [|x z].
    + rewrite dot_nil_r. destruct (Nat.leb j k), (Nat.ltb k (j + S m)), (k - j)%nat; reflexivity.
    + simpl. rewrite IH. rewrite Nat.add_succ_r. destruct (Nat.eqb k j) eqn:kj.
      * apply Nat.eqb_eq in kj. subst k. rewrite Nat.leb_refl, Nat.sub_diag.
        replace (Nat.leb (S j) j) with false by (symmetry; apply Nat.leb_gt; lia).
        replace (Nat.ltb j (S (j + m))) with true by (symmetry; apply Nat.ltb_lt; lia). ring.
      * apply Nat.eqb_neq in kj. replace (S j + m)%nat with (S (j + m)) by lia.
        destruct (Nat.leb (S j) k) eqn:a.
        -- apply Nat.leb_le in a. replace (Nat.leb j k) with true by (symmetry; apply Nat.leb_le; lia).
           destruct (Nat.ltb k (S (j + m))); [|ring]. replace (k - j)%nat with (S (k - S j)) by lia. ring.
        -- apply Nat.leb_gt in a. replace (Nat.leb j k) with false by (symmetry; apply Nat.leb_gt; lia). ring.
Qed.

Lemma within_root z k : length z = n -> (k < n)%nat -> form Sr z <= real (level c) ->
  - toR (nth k (root e) PrimFloat.zero) <= nth k z 0 <= toR (nth k (root e) PrimFloat.zero).
Proof.
  intros lz hk v. destruct fits_all as (_ & _ & _ & _ & h & _). destruct (h k hk) as [h0 h1].
  generalize (atleast0_sound _ _ h0 (point_in _)). intro r0.
  destruct (list_eq_dec Req_EM_T z (zeros n)) as [ez|nz].
  - rewrite ez, nth_zeros. lra.
  - generalize (keeps_inside _ _ _ _ z h1 (unit_list_in k) (point_in _) lz nz v).
    rewrite (dot_unit_list k n 0 z). simpl Nat.leb. rewrite Nat.add_0_l, Nat.sub_0_r.
    replace (Nat.ltb k n) with true by (symmetry; apply Nat.ltb_lt; lia). intro g.
    rewrite <- !Rsqr_pow2 in g. apply Rsqr_lt_abs_0 in g. rewrite (Rabs_right (toR _)) in g by lra.
    apply Rabs_def2 in g. lra.
Qed.

Lemma in_root x : inside c x -> inbox (map F.neg (root e)) (root e) (to_z x).
Proof.
  intros [l v]. rewrite <- (from_z x l), V_form in v. generalize (length_z x). intro lz. split.
  - apply forall2_nth with PrimFloat.zero 0. rewrite map_length, length_root; auto. rewrite map_length, length_root. intros k hk.
    rewrite (nth_indep _ _ (F.neg PrimFloat.zero)) by (rewrite map_length, length_root; auto). rewrite map_nth, toR_opp.
    apply within_root; auto.
  - apply forall2_nth with PrimFloat.zero 0. rewrite length_root; auto. rewrite length_root. intros k hk.
    apply within_root; auto.
Qed.

Lemma combine_nth_in {A B} (a : A) (b : B) l : forall m k, length l = length m -> (k < length l)%nat ->
  In (nth k l a, nth k m b) (combine l m).
Proof.
  intros m k h hk. rewrite <- combine_nth; auto. apply nth_In. rewrite combine_length. lia.
Qed.

Lemma coordinate_in k : enc (nth k (coordinates p) []) (nth k Tr []).
Proof. generalize coordinates_in. intro h. revert k. induction h; intros [|k]; simpl; auto; constructor. Qed.

Lemma nth_from_z x k : length x = n -> (k < n)%nat -> nth k x 0 = dot (nth k Tr []) (to_z x).
Proof.
  intros l hk. rewrite <- (from_z x l) at 1. unfold apply at 1. rewrite (nth_indep _ 0 (dot [] (to_z x))).
  now rewrite (map_nth (fun row => dot row (to_z x))). unfold ratios. rewrite !map_length. destruct square_T. congruence.
Qed.

Lemma set_in_domain x : inside c x ->
  Forall2 (fun one bounds => ratio (fst bounds) < one < ratio (snd bounds)) x (domain c).
Proof.
  intros [l v]. apply forall2_nth with 0 (Ratio 0 1, Ratio 0 1). exact l. rewrite l. intros k hk.
  destruct (nth k (domain c) (Ratio 0 1, Ratio 0 1)) as [lo hi] eqn:ed.
  destruct fits_all as (_ & _ & _ & _ & _ & h).
  assert (lc : length (coordinates p) = n) by (unfold prepare; simpl; rewrite map_length; apply square_T).
  assert (i : In (nth k (coordinates p) [], (lo, hi)) (combine (coordinates p) (domain c))).
  { rewrite <- ed. apply combine_nth_in. exact lc. lia. }
  destruct (h _ _ _ i) as (p1 & p2 & k1 & k2).
  generalize (positive_sound _ _ p1 (neg_in _ _ (ratio_in lo))) (positive_sound _ _ p2 (ratio_in hi)). simpl. intros q1 q2.
  assert (ea : enc (nth k (coordinates p) []) (nth k Tr [])) by apply coordinate_in.
  assert (ex : nth k x 0 = dot (nth k Tr []) (to_z x)) by now apply nth_from_z.
  destruct (list_eq_dec Req_EM_T x (zeros n)) as [ez|nz].
  - rewrite ez, nth_zeros. lra.
  - rewrite <- (from_z x l), V_form in v.
    generalize (keeps_inside _ _ _ _ (to_z x) k1 ea (ratio_in lo) (length_z x) (z_nonzero x l nz) v)
      (keeps_inside _ _ _ _ (to_z x) k2 ea (ratio_in hi) (length_z x) (z_nonzero x l nz) v).
    rewrite <- ex, <- !Rsqr_pow2. intros g1 g2. apply Rsqr_lt_abs_0 in g1, g2.
    rewrite (Rabs_left (ratio lo)) in g1 by lra. rewrite (Rabs_right (ratio hi)) in g2 by lra.
    apply Rabs_def2 in g1, g2. lra.
Qed.

(** Each state is bounded by V: what makes it converge. *)
Lemma bounds i : (i < n)%nat -> exists b, 0 < b /\ forall x, length x = n -> real (level c) * nth i x 0 ^ 2 <= b ^ 2 * V c x.
Proof.
  intro hi. destruct (nth i (domain c) (Ratio 0 1, Ratio 0 1)) as [lo hh] eqn:ed.
  destruct fits_all as (_ & _ & _ & _ & _ & h).
  assert (lc : length (coordinates p) = n) by (unfold prepare; simpl; rewrite map_length; apply square_T).
  assert (k : In (nth i (coordinates p) [], (lo, hh)) (combine (coordinates p) (domain c))).
  { rewrite <- ed. apply combine_nth_in. exact lc. lia. }
  destruct (h _ _ _ k) as (_ & p2 & _ & k2). generalize (positive_sound _ _ p2 (ratio_in hh)). intro q2.
  exists (ratio hh). split; auto. intros x l.
  assert (ex : nth i x 0 = dot (nth i Tr []) (to_z x)) by now apply nth_from_z.
  destruct (list_eq_dec Req_EM_T x (zeros n)) as [ez|nz].
  - rewrite ez, nth_zeros. assert (V c (zeros n) = 0).
    { rewrite <- at_zero, V_form. unfold form. rewrite dot_comm, dot_zeros. reflexivity. } rewrite H. simpl. lra.
  - rewrite ex. replace (V c x) with (form Sr (to_z x)) by (rewrite <- V_form, from_z; auto). left.
    apply (keeps_sound _ _ _ _ k2); auto using ratio_in, length_z, z_nonzero. now apply coordinate_in.
Qed.

(** * At rest *)

Lemma chainedb_sound ls : forall k, chainedb (length (channels c)) ls k = true -> chained c ls k.
Proof.
  induction ls as [|l ls IH]; intros k h; simpl in h |- *.
  - now apply Nat.eqb_eq.
  - apply andb_prop in h. destruct h as [h0 h]. split; [|now apply IH]. apply Forall_forall. intros row hr.
    rewrite forallb_forall in h0. now apply Nat.eqb_eq, h0.
Qed.

Lemma fits_together : chained c (layers c) n.
Proof. apply chainedb_sound. apply formed_all. Qed.

Lemma length_net ls : forall x, chained c ls (length x) -> length (net ls x) = length (channels c).
Proof.
  induction ls as [|l [|l' ls] IH]; intros x h.
  - exact h.
  - simpl in h |- *. unfold affine. rewrite map_length. apply h.
  - change (net (l :: l' :: ls) x) with (net (l' :: ls) (map tanh (affine l x))). apply IH.
    rewrite map_length. unfold affine. rewrite map_length. apply h.
Qed.

Lemma length_outputs x : length x = n -> length (net (layers c) x) = length (channels c).
Proof. intro h. apply length_net. rewrite h. apply fits_together. Qed.

Lemma net_at_zero ls : forallb (forallb (fun row : list dyadic * dyadic => Z.eqb (mantissa (snd row)) 0)) ls = true ->
  forall k, exists m, net ls (zeros k) = zeros m.
Proof.
  assert (one : forall l : layer, forallb (fun row => Z.eqb (mantissa (snd row)) 0) l = true ->
    forall k, affine l (zeros k) = zeros (length l)).
  { intros l h k. induction l as [|[w b] l IH]; simpl in *; auto. apply andb_prop in h. destruct h as [h0 h].
    apply Z.eqb_eq in h0. rewrite IH; auto. unfold zeros. simpl. f_equal. fold (zeros k). rewrite dot_zeros. unfold real. simpl in h0. rewrite h0. ring. }
  assert (th : forall m, map tanh (zeros m) = zeros m).
  { induction m; simpl; auto. unfold zeros in *. simpl. now rewrite tanh_zero, IHm. }
  induction ls as [|l [|l' ls] IH]; intros h k.
  - now exists k.
  - simpl in h. rewrite andb_true_r in h. exists (length l). now apply one.
  - simpl in h. apply andb_prop in h. destruct h as [h0 h].
    change (net (l :: l' :: ls) (zeros k)) with (net (l' :: ls) (map tanh (affine l (zeros k)))).
    rewrite one, th; auto.
Qed.

Lemma act_at_rest ch v : channel_fits (squashed c) (centred c) ch = true -> rests_here c ch = true -> (centred c = NotCentred -> v = 0) ->
  act (squashed c) (centred c) ch v v = ratio (rest ch).
Proof.
  unfold rests_here, act. destruct (centred c) eqn:k; intros f h h0.
  - ring.
  - simpl in f. destruct (squashed c); [|discriminate]. destruct (reachable_sound _ f) as (ns & b & _). unfold share in b.
    simpl. replace (v - v + artanh ((ratio (rest ch) - real (offset ch)) / real (scale ch)))
      with (artanh ((ratio (rest ch) - real (offset ch)) / real (scale ch))) by ring.
    rewrite tanh_of_artanh; auto. field; auto.
  - rewrite h0; auto. replace (squash (squashed c) 0) with 0 by (destruct (squashed c); simpl; auto; now rewrite tanh_zero).
    rewrite <- dyadicQ_real, <- (dyadicQ_real (offset ch)), (Qeq_bool_real _ _ h), ratioQ_ratio. ring.
Qed.

Lemma policy_at_rest : policy c (zeros n) = map (fun one => ratio (rest one)) (channels c).
Proof.
  unfold policy. generalize (length_outputs (zeros n) (length_zeros n)).
  destruct formed_all as (_ & _ & _ & _ & _ & _ & hf & hr & hu & _).
  assert (z : centred c = NotCentred -> forall v, In v (net (layers c) (zeros n)) -> v = 0).
  { intros k v hv. unfold unbiased in hu. rewrite k in hu. destruct (net_at_zero _ hu n) as [m em]. rewrite em in hv.
    now apply repeat_spec in hv. }
  revert z hf hr. generalize (net (layers c) (zeros n)). induction (channels c) as [|ch cs IH]; intros [|v vs] z hf hr l;
    simpl in l; try discriminate; simpl; auto.
  simpl in hf, hr. apply andb_prop in hf, hr. destruct hf as [f0 hf], hr as [h0 hr]. f_equal.
  - apply act_at_rest; auto. intro k. apply z; simpl; auto.
  - apply IH; auto. intros k w hw. apply z; simpl; auto.
Qed.

Lemma field_at_rest : F c (zeros n) = zeros n.
Proof.
  unfold F. rewrite policy_at_rest. destruct formed_all as (lf & _ & _ & _ & _ & _ & _ & _ & _ & h & _).
  transitivity (zeros (length (field c))); [|now rewrite lf]. clear lf.
  induction (field c) as [|f fs IH]; simpl; auto.
  simpl in h. apply andb_prop in h. destruct h as [h0 h]. unfold zeros at 3. simpl. f_equal; [|now apply IH].
  destruct (exactQ (map (fun ch => ratioQ (rest ch)) (channels c)) f) as [q|] eqn:eq; [|discriminate].
  simpl in h0. rewrite <- Q2R_zero, <- (Qeq_bool_real _ _ h0), <- (exact_sound n _ _ _ eq). f_equal.
  rewrite map_map. reflexivity.
Qed.

(** * On a box *)

Section Boxed.

Variables (b : box) (z y : list R).
Hypothesis near : about b z y.
Let d := minus z y.

Lemma d_in : enc (apart b) d. Proof. apply near. Qed.
Lemma zero_in_D : enc (apart b) (zeros (length d)). Proof. apply near. Qed.

Lemma outputs_in : enc (outputs_at_0 p) (net (layers c) (zeros n)).
Proof.
  simpl. assert (h : all_hold [] (netQ [] (layersI (layers c)) (repeat (constant (whole 0)) n))
    (net (layers c) (zeros n)) (net (layers c) (zeros n))).
  { apply net_holds; try constructor. clear. induction n; simpl; constructor; auto. apply constant_holds, zero_in. }
  clear - h. induction h; simpl; constructor; auto. apply H.
Qed.

Lemma policy_holds : all_hold d (policyQ c p b) (policy c (apply Tr z)) (policy c (apply Tr y)).
Proof.
  unfold policyQ, policy. apply acts_hold; auto using d_in, zero_in_D, outputs_in.
  - apply formed_all.
  - apply net_holds; auto using d_in, zero_in_D. apply linears_hold; auto. apply coordinates_in.
Qed.

Lemma field_holds u fq : all_hold d u (policy c (apply Tr z)) (policy c (apply Tr y)) -> fieldQ c p b u = Some fq ->
  Forall (defined (apply Tr z) (policy c (apply Tr z))) (field c) /\ all_hold d fq (F c (apply Tr z)) (F c (apply Tr y)).
Proof.
  intros hu h. apply (values_hold d (apart b) d_in zero_in_D _ _ _ _ _ _ (linears_hold _ _ _ _ _ near coordinates_in) hu _ _ h).
Qed.

End Boxed.

Lemma roomy_sound ch v w : roomy c ch = true ->
  ratio (least ch) <= act (squashed c) (centred c) ch v w <= ratio (greatest ch).
Proof.
  assert (key : forall t, -1 < t < 1 ->
    Qle_bool (ratioQ (least ch)) (dyadicQ (offset ch) - Qabs.Qabs (dyadicQ (scale ch))) &&
    Qle_bool (dyadicQ (offset ch) + Qabs.Qabs (dyadicQ (scale ch))) (ratioQ (greatest ch)) = true ->
    ratio (least ch) <= real (scale ch) * t + real (offset ch) <= ratio (greatest ch)).
  { intros t ht. rewrite andb_true_iff. intros [h1 h2]. apply Qle_bool_real in h1, h2.
    rewrite Q2R_minus, absolute, !dyadicQ_real, ratioQ_ratio in h1. rewrite Q2R_plus, absolute, !dyadicQ_real, ratioQ_ratio in h2.
    generalize (Rle_abs (real (scale ch))) (Rle_abs (- real (scale ch))). rewrite Rabs_Ropp. intros b1 b2.
    generalize (Rabs_pos (real (scale ch))). intro b3.
    assert (real (scale ch) * t <= Rabs (real (scale ch))) by nra.
    assert (- Rabs (real (scale ch)) <= real (scale ch) * t) by nra. lra. }
  unfold roomy, act. destruct (squashed c), (centred c); try discriminate; apply key; apply tanh_bounds.
Qed.

Lemma bounded_sound d : forall cs u v w ws, bounded c cs u = true ->
  all_hold d u (acts (squashed c) (centred c) cs v w) ws ->
  Forall2 (fun one ch => ratio (least ch) <= one <= ratio (greatest ch)) (acts (squashed c) (centred c) cs v w) cs.
Proof.
  induction cs as [|ch cs IH]; intros [|q u] v w ws h k; simpl in h; try discriminate.
  - constructor.
  - simpl in k |- *. destruct v as [|v0 v]; [inversion k|]. destruct w as [|w0 w]; [inversion k|].
    inversion k as [|? ? x ? ? xs k0 k1]; subst. apply andb_prop in h. destruct h as [h0 h]. constructor.
    + apply orb_prop in h0. destruct h0 as [h0|h0]. now apply roomy_sound.
      apply andb_prop in h0. destruct h0 as [h1 h2]. destruct k0 as (r1 & _).
      generalize (atleast0_sound _ _ h1 (sub_in _ _ _ _ r1 (ratio_in _))) (atleast0_sound _ _ h2 (sub_in _ _ _ _ (ratio_in _) r1)). lra.
    + apply (IH u v w xs); auto.
Qed.

(** What has to hold at each state of the set. *)
Definition good (x : list R) : Prop :=
  Forall (defined x (policy c x)) (field c)
  /\ Forall2 (fun one ch => ratio (least ch) <= one <= ratio (greatest ch)) (policy c x) (channels c)
  /\ (x <> zeros n -> Vdot c x + ratio rate * V c x < 0).

Lemma Vdot_form z : 2 * dot (apply Yr z) (F c (apply Tr z)) = Vdot c (apply Tr z).
Proof. unfold Vdot. now rewrite apply_product. Qed.

Lemma falls_good b z y k : about b z y -> falls c p b k = true -> form Sr z <= real (level c) -> good (apply Tr z).
Proof.
  intros near h v. unfold falls in h. rewrite !andb_true_iff in h. destruct h as [[h0 h1] h].
  generalize (policy_holds b z y near). intro hp.
  destruct (fieldQ c p b (policyQ c p b)) as [fq|] eqn:ef; [|discriminate].
  destruct (field_holds b z y near _ _ hp ef) as [hd hf].
  split; auto. split. apply (bounded_sound _ _ _ _ _ _ h0 hp).
  intros _. set (k' := toR k). generalize (atleast0_sound _ _ h1 (point_in k)). fold k'. intro pk.
  assert (dq : holds (minus z y) (decayQ p b (point k) fq)
    (2 * dot (apply Yr z) (F c (apply Tr z)) + ratio rate * form Sr z + k' * (real (level c) + - form Sr z))
    (2 * dot (apply Yr y) (F c (apply Tr y)) + ratio rate * form Sr y + k' * (real (level c) + - form Sr y))).
  { generalize (form_holds _ _ _ _ _ near shape_in). intro hv. assert (near' := near). destruct near' as (n1 & n2 & n3 & n4 & n5 & n6).
    apply tighten_holds; auto. repeat apply plus_holds.
    - apply scale_holds. apply (whole_in 2). apply dot_holds; auto. apply linears_hold; [exact near | apply gradient_in].
    - apply scale_holds; auto. apply ratio_in.
    - apply scale_holds. apply point_in. apply plus_holds. apply constant_holds, dyadic_in. now apply neg_holds. }
  destruct dq as (d1 & _). generalize (positive_sound _ _ h (neg_in _ _ d1)). intro g.
  rewrite Vdot_form in g. rewrite V_form. assert (0 <= k' * (real (level c) + - form Sr z)) by (apply Rmult_le_pos; lra). lra.
Qed.

(** * The core *)

Hypothesis core_ok : core_holds c p = true.

Lemma slopes_of fq v w z : all_hold z fq v w -> w = zeros (length w) ->
  exists G, encs (map slopes fq) G /\ apply G z = v.
Proof.
  induction 1 as [|q v0 w0 fq v w h hs IH]; intro k.
  - exists []. split. constructor. reflexivity.
  - unfold zeros in k. simpl in k. injection k as k0 k. destruct (IH k) as [G [g1 g2]].
    destruct h as (_ & _ & _ & g & g3 & g4). exists (g :: G). split. constructor; auto.
    simpl. rewrite g2. f_equal. lra.
Qed.

Lemma dot_padded g m z : dot (plus Rplus g (zeros m)) z = dot g z.
Proof. rewrite dot_plus, (dot_comm (zeros m)), dot_zeros. ring. Qed.

Lemma core_good z : length z = n -> enc (heart p) z -> good (apply Tr z).
Proof.
  intros lz hz. generalize core_ok. unfold core_holds.
  set (b := box_of (heart p) (map (fun _ => whole 0) (heart p))).
  assert (near : about b z (zeros n)).
  { apply box_about; auto. 2: rewrite length_zeros; auto.
    assert (lh : length (heart p) = n) by (simpl; rewrite map_length; apply length_core).
    rewrite <- lh. clear. induction (heart p); simpl; constructor; auto. apply zero_in. }
  rewrite andb_true_iff. intros [h0 h]. generalize (policy_holds b z (zeros n) near). intro hp.
  destruct (fieldQ c p b (policyQ c p b)) as [fq|] eqn:ef; [|discriminate].
  destruct (field_holds b z (zeros n) near _ _ hp ef) as [hd hf].
  split; auto. split. apply (bounded_sound _ _ _ _ _ _ h0 hp).
  intro nx. rewrite !andb_true_iff in h. destruct h as [[ha hs] hm].
  rewrite at_zero, field_at_rest, minus_zeros in hf by auto.
  destruct (slopes_of _ _ _ _ hf) as [G [g1 g2]]. now rewrite length_zeros.
  pose (G' := map (fun g => plus Rplus g (zeros n)) G).
  assert (eG : apply G' z = F c (apply Tr z)).
  { rewrite <- g2. unfold G', apply. rewrite map_map. apply map_ext. intro. apply dot_padded. }
  assert (iG : encs (map (fun q => plus add (slopes q) (repeat (whole 0) n)) fq) G').
  { unfold G'. clear - g1. remember (map slopes fq) as S. revert fq HeqS. induction g1; intros [|q fq] k; try discriminate; simpl; constructor.
    - injection k as k0 k. subst. apply plus_in; auto. apply repeat_in, zero_in.
    - apply IHg1. now injection k. }
  pose (A := product (transpose 0 n Yr) G').
  set (AI := productI (transpose (whole 0) n (gradient p)) (map (fun q => plus add (slopes q) (repeat (whole 0) n)) fq)) in *.
  assert (iA : encs AI A) by (apply product_in; auto; apply transpose_in, gradient_in).
  pose (M := zip (fun a s => map Ropp (plus Rplus (map (Rmult 2) a) (map (Rmult (ratio rate)) s))) A Sr).
  set (MI := zip (fun a s => map I.neg (plus add (map (mul (whole 2)) a) (map (mul (rateI p)) s))) AI (shape p)) in *.
  assert (iM : encs MI M).
  { unfold MI, M. generalize shape_in. generalize (shape p) Sr. clear - iA. induction iA; intros S X hS; simpl. constructor.
    inversion hS; subst; constructor; auto.
    - assert (k : enc (plus add (map (mul (whole 2)) x) (map (mul (rateI p)) x0)) (plus Rplus (map (Rmult 2) y) (map (Rmult (ratio rate)) y0))).
      { apply plus_in; apply scale_in; auto. apply (whole_in 2). apply ratio_in. }
      now apply negs_in.
    - now apply IHiA. }
  assert (nz : z <> zeros n) by (intro k; apply nx; rewrite k; apply at_zero).
  generalize (definite_sound n MI M hm iM (square_enc _ _ _ iM (squareb_sound _ _ hs)) z lz nz).
  assert (eM : forall w, dot w (apply M z) = - (2 * dot w (apply A z) + ratio rate * dot w (apply Sr z))).
  { assert (l : length A = length Sr).
    { apply Nat.eqb_eq in ha. rewrite <- (forall2_length _ _ _ iA), <- (forall2_length _ _ _ shape_in). exact ha. }
    unfold M. clear - l. revert l. generalize Sr. induction A as [|a A IH]; intros [|s S] l [|w0 w]; simpl in *; try discriminate; try ring.
    rewrite IH by (now injection l). rewrite dot_neg, dot_plus, !dot_scale. ring. }
  unfold form. rewrite eM. unfold A. rewrite apply_product, dot_transpose, eG by apply square_Y.
  intro g. rewrite <- Vdot_form, V_form. unfold form. lra.
Qed.

(** * The tree *)

Lemma leaf_good lo hi z k : inbox lo hi z -> length z = n -> form Sr z <= real (level c) ->
  leaf c p (box_of (zip segment lo hi) (zip halfway lo hi)) k = true -> good (apply Tr z).
Proof.
  intros hz lz v h.
  assert (near : about (box_of (zip segment lo hi) (zip halfway lo hi)) z (middle_of lo hi)).
  { apply box_about. now apply inbox_segments. apply middle_in. now apply middle_length. }
  set (b := box_of _ _) in *. unfold leaf in h. destruct (outside p b) eqn:ho.
  - exfalso. unfold outside in ho. destruct near as (n1 & _).
    assert (f : form Sr z ∈ formI 0 (at_all b) (shape p) (at_all b)) by (apply (form_in _ z n1 _ _ shape_in); auto).
    generalize (positive_sound _ _ ho (sub_in _ _ _ _ f (dyadic_in (level c)))). lra.
  - destruct (within (at_all b) (heart p)) eqn:hw.
    + apply core_good; auto. apply (within_sound _ _ _ hw). apply near.
    + now apply (falls_good b z (middle_of lo hi) k).
Qed.

Lemma tree_good t : forall lo hi, tree_holds c p t lo hi = true ->
  forall z, inbox lo hi z -> length z = n -> form Sr z <= real (level c) -> good (apply Tr z).
Proof.
  induction t as [k|j m below IHb above IHa]; intros lo hi h z hz lz v.
  - now apply (leaf_good lo hi z k).
  - simpl in h. apply andb_prop in h. destruct h as [hb ha]. destruct hz as [h1 h2].
    destruct (Rle_dec (nth j z 0) (toR m)).
    + apply (IHb _ _ hb); auto. split; auto. now apply set_high.
    + apply (IHa _ _ ha); auto. split; auto. apply set_low; auto. lra.
Qed.

Hypothesis tree_ok : tree_holds c p (splits e) (map F.neg (root e)) (root e) = true.

Lemma all_good x : inside c x -> good x.
Proof.
  intro h. assert (l : length x = n) by apply h. rewrite <- (from_z x l).
  apply (tree_good _ _ _ tree_ok). now apply in_root. apply length_z. rewrite <- V_form, from_z; auto. apply h.
Qed.

End Sound.

Lemma symmetric_sound n (M : list (list dyadic)) : length M = n -> symmetricb n M = true -> symmetric (map (map real) M).
Proof.
  intros l h i j hi hj. rewrite map_length, l in hi, hj.
  assert (g : forall i j, nth j (nth i (map (map real) M) []) 0 = real (nth j (nth i M []) zeroD)).
  { intros a b. rewrite <- (map_nth real). rewrite <- (map_nth (map real)). f_equal. unfold real. simpl. ring. }
  rewrite !g. unfold symmetricb in h. rewrite forallb_forall in h.
  assert (ii : In i (seq 0 n)) by (apply in_seq; lia). assert (ij : In j (seq 0 n)) by (apply in_seq; lia).
  specialize (h i ii). rewrite forallb_forall in h. specialize (h j ij). unfold same in h.
  apply andb_prop in h. destruct h as [h1 h2]. apply Z.eqb_eq in h1, h2. unfold real. now rewrite h1, h2.
Qed.

(** The claim holds of every certificate for which the check says so, whatever the evidence is. *)
Theorem sound (c : certificate) (rate : rational) (e : evidence) : check c rate e = true -> claim c (ratio rate).
Proof.
  unfold check. rewrite !andb_true_iff. intros [formed [[fits core_ok] tree_ok]].
  assert (hf : length (field c) = states c /\ square (states c) (P c)).
  { split. now apply (length_field c rate e). now apply (square_P c rate e). }
  assert (hs : symmetric (matrix c)).
  { apply (symmetric_sound (states c)). apply hf. apply (formed_all c rate e formed). }
  assert (hl : 0 < real (level c)) by now apply (level_positive c rate e).
  assert (hr : 0 < ratio rate) by now apply (rate_positive c rate e).
  assert (good_all : forall x, inside c x -> good c rate x) by now apply (all_good c rate e).
  assert (smooth : forall x, inside c x -> Forall (defined x (policy c x)) (field c)) by (intros x h; now apply good_all).
  assert (pos : forall x, length x = states c -> x <> zeros (states c) -> 0 < V c x).
  { intros x l h. now apply (V_positive c rate e). }
  assert (strictly : forall x, inside c x -> x <> zeros (states c) -> Vdot c x < 0 /\ Vdot c x + ratio rate * V c x < 0).
  { intros x h nz. destruct (good_all x h) as (_ & _ & g). specialize (g nz).
    assert (0 < V c x) by (apply pos; auto; apply h). assert (0 < ratio rate * V c x) by now apply Rmult_lt_0_compat. lra. }
  assert (falling : forall x, inside c x -> x <> zeros (states c) -> Vdot c x < 0 /\ Vdot c x + ratio rate * V c x <= 0).
  { intros x h nz. destruct (strictly x h nz). lra. }
  constructor; auto.
  - destruct (formed_all c rate e formed) as (_ & _ & nl & _). split. apply hf. split. apply hf. split. exact nl.
    now apply (fits_together c rate e).
  - split. now apply (policy_at_rest c rate e). now apply (field_at_rest c rate e).
  - intros x h. now apply (set_in_domain c rate e).
  - intros x h. now apply good_all.
  - now apply (trajectories_decay c (ratio rate)).
  - intros eps he. apply (trajectories_converge c (ratio rate) hf hs hl smooth falling hr (bounds c rate e formed fits) eps he).
  - intros eps he. apply (trajectories_converge c (ratio rate) hf hs hl smooth falling hr (bounds c rate e formed fits) eps he).
Qed.

