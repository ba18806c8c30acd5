(** Linear algebra on lists: products of matrices, changes of coordinates, and positive definite forms. *)
From Coq Require Import Reals List ZArith Lra Lia Bool.
Require Import Vectors Spec Enclosure.
Import ListNotations.
Open Scope R_scope.

(** * Sums and products *)

Lemma dot_nil_r a : dot a [] = 0.
Proof. destruct a; reflexivity. Qed.

Lemma dot_plus a : forall b z, dot (plus Rplus a b) z = dot a z + dot b z.
Proof.
  induction a as [|p a IH]; intros [|q b] z; simpl; try rewrite ?dot_nil_r; try lra.
  destruct z; simpl; try lra. rewrite IH. ring.
Qed.

Lemma dot_scale k a : forall z, dot (map (Rmult k) a) z = k * dot a z.
Proof. induction a; intros [|q z]; simpl; try ring. rewrite IHa. ring. Qed.

Lemma length_zeros n : length (zeros n) = n.
Proof. apply repeat_length. Qed.

(** A row of numbers times a matrix: the sum of its rows, each times its number. *)
Fixpoint combine_rows {A} (op times : A -> A -> A) (r : list A) (M : list (list A)) : list A :=
  match r, M with
  | p :: r, row :: M => plus op (map (times p) row) (combine_rows op times r M)
  | _, _ => []
  end.

Definition rows := combine_rows Rplus Rmult.
Definition rowsI := combine_rows add mul.

Lemma dot_rows r : forall M z, dot (rows r M) z = dot r (apply M z).
Proof.
  induction r as [|p r IH]; intros [|row M] z; simpl; auto.
  unfold rows in *. simpl. rewrite dot_plus, dot_scale, IH. reflexivity.
Qed.

Lemma rows_in r M : forall x X, enc r x -> encs M X -> enc (rowsI r M) (rows x X).
Proof.
  revert M. induction r as [|p r IH]; intros M x X h1 h2.
  - inversion h1; subst. apply Forall2_nil.
  - inversion h1 as [|? x0 ? x' h0 h1']; subst. inversion h2 as [|? X0 ? X' k0 h2']; subst. apply Forall2_nil.
    apply plus_in. now apply scale_in. now apply IH.
Qed.

(** The product of two matrices. *)
Definition product (A B : list (list R)) : list (list R) := map (fun r => rows r B) A.
Definition productI (A B : list (list I.type)) : list (list I.type) := map (fun r => rowsI r B) A.

Lemma apply_product A B z : apply (product A B) z = apply A (apply B z).
Proof. unfold apply at 1 2, product. rewrite map_map. apply map_ext. intro. apply dot_rows. Qed.

Lemma product_in A B X Y : encs A X -> encs B Y -> encs (productI A B) (product X Y).
Proof. intros h k; induction h; simpl; constructor; auto. now apply rows_in. Qed.

(** The transpose of a matrix with n columns. *)
Definition transpose {A} (o : A) (n : nat) (M : list (list A)) : list (list A) :=
  map (fun j => map (fun row => nth j row o) M) (seq 0 n).

Lemma column_in j M X : encs M X -> enc (map (fun row => nth j row (whole 0)) M) (map (fun row => nth j row 0) X).
Proof. intro h; induction h; simpl; constructor; auto. now apply nth_in. Qed.

Lemma transpose_in n M X : encs M X -> encs (transpose (whole 0) n M) (transpose 0 n X).
Proof.
  intro h. unfold transpose. induction (seq 0 n); simpl; constructor; auto. now apply column_in.
Qed.

Lemma map_nth_seq (r : list R) : forall k, map (fun j => nth (j - k) r 0) (seq k (length r)) = r.
Proof.
  induction r as [|p r IH]; intro k; simpl; auto. f_equal. now rewrite Nat.sub_diag.
  rewrite <- (IH (S k)) at 2. apply map_ext_in. intros j h. apply in_seq in h.
  replace (j - k)%nat with (S (j - S k)) by lia. reflexivity.
Qed.

Lemma dot_map_plus (A : Type) (f g : A -> R) (l : list A) :
  forall z, dot z (map (fun j => f j + g j) l) = dot z (map f l) + dot z (map g l).
Proof. induction l; intros [|q z]; simpl; try ring. rewrite IHl. ring. Qed.

Lemma dot_map_scale (A : Type) (f : A -> R) k (l : list A) : forall z, dot z (map (fun j => f j * k) l) = k * dot z (map f l).
Proof. induction l; intros [|q z]; simpl; try ring. rewrite IHl. ring. Qed.

(** z'(M'w) = (M z)'w *)
Lemma dot_transpose n M z : Forall (fun row => length row = n) M ->
  forall w, dot z (apply (transpose 0 n M) w) = dot (apply M z) w.
Proof.
  intros h w. unfold apply, transpose. rewrite map_map. revert w. induction h as [|row M h0 h IH]; intro w.
  - simpl. transitivity (dot z (map (fun _ : nat => 0 * 0) (seq 0 n))).
    f_equal. apply map_ext; intros; simpl; ring.
    rewrite (dot_map_scale _ (fun _ => 0) 0). ring.
  - destruct w as [|q w].
    + simpl. transitivity (dot z (map (fun _ : nat => 0 * 0) (seq 0 n))).
      f_equal. apply map_ext; intros; simpl; ring.
      rewrite (dot_map_scale _ (fun _ => 0) 0). ring.
    + simpl. rewrite (dot_map_plus _ (fun j => nth j row 0 * q) (fun j => dot (map (fun r => nth j r 0) M) w)).
      rewrite IH, (dot_map_scale _ (fun j => nth j row 0) q).
      replace (map (fun j => nth j row 0) (seq 0 n)) with row. rewrite (dot_comm z row). ring.
      rewrite <- h0. rewrite <- (map_nth_seq row 0) at 1. apply map_ext. intro; now rewrite Nat.sub_0_r.
Qed.

(** x'P x in the coordinates z of x = T z. *)
Definition congruence (n : nat) (P T : list (list R)) : list (list R) := product (transpose 0 n T) (product P T).

Lemma form_congruence n P T z : Forall (fun row => length row = n) T ->
  form (congruence n P T) z = form P (apply T z).
Proof.
  intro h. unfold form, congruence. rewrite !apply_product. now apply dot_transpose.
Qed.

(** * Positive definite forms, by elimination *)

Definition heads {A} (o : A) (M : list (list A)) : list A := map (hd o) M.
Definition tails {A} (M : list (list A)) : list (list A) := map (@tl A) M.

Lemma dot_apply_cons w M z0 z : dot w (apply M (z0 :: z)) = z0 * dot (heads 0 M) w + dot w (apply (tails M) z).
Proof.
  revert w. induction M as [|row M IH]; intros [|w0 w]; simpl; try ring. rewrite IH.
  destruct row as [|p row]; simpl; ring.
Qed.

Fixpoint zip {A B C} (f : A -> B -> C) (a : list A) (b : list B) : list C :=
  match a, b with
  | p :: a, q :: b => f p q :: zip f a b
  | _, _ => []
  end.

Lemma zip_length {A B C} (f : A -> B -> C) a : forall b, length a = length b -> length (zip f a b) = length a.
Proof. induction a; intros [|q b] h; simpl in *; auto; try discriminate. Qed.

Lemma zip_in (f : I.type -> I.type -> I.type) (g : R -> R -> R) a b x y :
  (forall i j p q, p ∈ i -> q ∈ j -> g p q ∈ f i j) -> enc a x -> enc b y -> enc (zip f a b) (zip g x y).
Proof.
  intros h ha; revert b y; induction ha; intros b' y' hb; simpl. constructor.
  inversion hb; subst; constructor; auto. now apply IHha.
Qed.

Lemma dot_zip_plus a : forall b z, length a = length b -> dot (zip Rplus a b) z = dot a z + dot b z.
Proof.
  induction a as [|p a IH]; intros [|q b] [|s z] h; simpl in *; try discriminate; try ring. rewrite IH; auto. ring.
Qed.

(** The matrix M less k times the product of a column and a row. *)
Definition less (k : R) (M : list (list R)) (c r : list R) : list (list R) :=
  zip (fun row p => zip (fun m q => m - p * q * k) row r) M c.
Definition lessI (k : I.type) (M : list (list I.type)) (c r : list I.type) : list (list I.type) :=
  zip (fun row p => zip (fun m q => sub m (mul (mul p q) k)) row r) M c.

Lemma dot_less_row k p row : forall r z, length row = length r ->
  dot (zip (fun m q => m - p * q * k) row r) z = dot row z - k * p * dot r z.
Proof.
  induction row as [|m row IH]; intros [|q r] [|s z] h; simpl in *; try discriminate; try ring. rewrite IH; auto. ring.
Qed.

Lemma dot_less k M r z : Forall (fun row => length row = length r) M ->
  forall c w, length M = length c -> dot w (apply (less k M c r) z) = dot w (apply M z) - k * dot w c * dot r z.
Proof.
  intro h; induction h as [|row M h0 h IH]; intros [|p c] w hc; simpl in *; try discriminate.
  - rewrite dot_nil_r. ring.
  - destruct w as [|q w]; simpl. ring. injection hc as hc.
    unfold less in IH. rewrite dot_less_row, IH; auto. ring.
Qed.

Lemma less_in k K M X c C r R' : K ∈ k -> encs M X -> enc c C -> enc r R' -> encs (lessI k M c r) (less K X C R').
Proof.
  intros hk h hc hr; revert c C hc. induction h as [|row Row M X h0 h IH]; intros c C hc; simpl. constructor.
  inversion hc; subst; constructor.
  - apply zip_in; auto. intros. auto using sub_in, mul_in.
  - now apply IH.
Qed.

(** Whether every matrix with entries in these intervals has a positive definite form. *)
Fixpoint definite (n : nat) (M : list (list I.type)) : bool :=
  match n, M with
  | O, [] => true
  | S n, (a :: r) :: M =>
      positiveI a &&
      (let b := zip add r (heads (whole 0) M) in
       definite n (lessI (I.inv prec (mul (whole 4) a)) (tails M) b b))
  | _, _ => false
  end.

Lemma heads_in M X : encs M X -> enc (heads (whole 0) M) (heads 0 X).
Proof. intro h; induction h as [|? ? ? ? h0]; simpl; constructor; auto. destruct h0; simpl; auto. apply zero_in. Qed.

Lemma tails_in M X : encs M X -> encs (tails M) (tails X).
Proof. intro h; induction h as [|? ? ? ? h0]; simpl; constructor; auto. destruct h0; simpl; auto. constructor. Qed.

Lemma square_tails n M : Forall (fun row : list R => length row = S n) M -> Forall (fun row => length row = n) (tails M).
Proof. intro h; induction h as [|row M h0]; simpl; constructor; auto. destruct row; simpl in *; lia. Qed.

Lemma length_less k M c r : length M = length c -> length (less k M c r) = length M.
Proof. apply zip_length. Qed.

Lemma square_less k M c r : Forall (fun row => length row = length r) M -> Forall (fun row => length row = length r) (less k M c r).
Proof.
  intro h; revert c; induction h as [|row M h0 h]; intros [|p c]; simpl; constructor; auto.
  - rewrite zip_length; auto.
  - apply IHh.
Qed.

Theorem definite_sound n : forall M X, definite n M = true -> encs M X -> square n X ->
  forall z, length z = n -> z <> zeros n -> 0 < form X z.
Proof.
  induction n as [|n IH]; intros M X h k [l s] z lz nz.
  - destruct z; try discriminate. now elim nz.
  - simpl in h. inversion k as [|row0 Row0 M' X' kr km]; subst M X. discriminate.
    inversion kr as [|a0 a r0 r ka kr']; subst row0 Row0. discriminate.
    apply andb_prop in h. destruct h as [hp h].
    inversion s as [|? ? s0 s']; subst. simpl in l, s0. injection l as l. injection s0 as s0.
    destruct z as [|z0 z]; try discriminate. simpl in lz. injection lz as lz.
    generalize (positive_sound _ _ hp ka). intro pa.
    pose (b := zip Rplus r (heads 0 X')). pose (kk := / (4 * a)).
    assert (lh : length (heads 0 X') = n) by (unfold heads; rewrite map_length; auto).
    assert (lb : length b = n) by (unfold b; rewrite zip_length; congruence).
    assert (ltl : length (tails X') = n) by (unfold tails; rewrite map_length; auto).
    assert (st : Forall (fun row => length row = length b) (tails X')) by (rewrite lb; now apply square_tails).
    assert (eb : enc (zip add r0 (heads (whole 0) M')) b).
    { apply zip_in; auto using add_in, heads_in. }
    assert (ek : kk ∈ I.inv prec (mul (whole 4) a0)).
    { apply inv_in. lra. apply mul_in; auto. apply (whole_in 4). }
    pose (X'' := less kk (tails X') b b).
    assert (step : forall y, length y = n -> y <> zeros n -> 0 < form X'' y).
    { intros y ly ny. apply (IH _ X'' h); auto.
      - apply less_in; auto. now apply tails_in.
      - split. unfold X''. rewrite length_less; congruence.
        unfold X''. rewrite <- lb. now apply square_less. }
    assert (e : form ((a :: r) :: X') (z0 :: z) = a * (z0 + dot b z / (2 * a)) ^ 2 + form X'' z).
    { unfold form at 1. simpl apply. simpl dot at 1. rewrite dot_apply_cons. unfold form, X''. rewrite dot_less; auto; try congruence.
      rewrite (dot_comm z b). unfold b. rewrite !dot_zip_plus by congruence. unfold kk.
      field. lra. }
    rewrite e. destruct (list_eq_dec Req_EM_T z (zeros n)) as [ez|ne].
    + subst z. unfold form. rewrite (dot_comm (zeros n)), !dot_zeros.
      assert (z0 <> 0) by (intro; subst; now apply nz).
      replace (a * (z0 + 0 / (2 * a)) ^ 2 + 0) with (a * (z0 * z0)) by (field; lra).
      apply Rmult_lt_0_compat; auto. now apply Rsqr_pos_lt.
    + generalize (step z lz ne) (pow2_ge_0 (z0 + dot b z / (2 * a))). intros u v.
      assert (0 <= a * (z0 + dot b z / (2 * a)) ^ 2) by (apply Rmult_le_pos; lra). lra.
Qed.
