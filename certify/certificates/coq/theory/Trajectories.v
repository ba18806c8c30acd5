(** What the conditions of a certificate say of trajectories: none that starts in {V <= c2} leaves it, and V falls along
    it at the rate that was shown. No solution has to be the only one from its start. *)
From Coq Require Import Reals List Lra Lia.
Require Import Vectors Spec.
Import ListNotations.
Open Scope R_scope.

(** * Continuity *)

(** The usual words for continuity. *)
Lemma continuity_near (f : R -> R) (t : R) :
  continuity_pt f t <->
  forall eps, 0 < eps -> exists delta, 0 < delta /\ forall s, Rabs (s - t) < delta -> Rabs (f s - f t) < eps.
Proof.
  split; intros H eps Heps; destruct (H eps Heps) as [delta [Hd H']]; exists delta; split; try exact Hd.
  - intros s Hs. destruct (Req_dec t s) as [<- | Hne].
    + rewrite Rminus_diag_eq, Rabs_R0; [exact Heps | reflexivity].
    + apply (H' s). split; [split; [exact I | exact Hne] | exact Hs].
  - intros s [_ Hs]. apply H'. exact Hs.
Qed.

(** Where a continuous function is below a number, it is so nearby. *)
Lemma stays_below (f : R -> R) (t b : R) :
  continuity_pt f t -> f t < b -> exists delta, 0 < delta /\ forall s, Rabs (s - t) < delta -> f s < b.
Proof.
  intros Hf Hb. destruct (proj1 (continuity_near f t) Hf (b - f t)) as [delta [Hd H]]; [lra |].
  exists delta. split; [exact Hd |]. intros s Hs. specialize (H s Hs). apply Rabs_def2 in H. lra.
Qed.

(** Functions with the same values are continuous at the same points. *)
Lemma continuity_same (f g : R -> R) (t : R) : (forall s, f s = g s) -> continuity_pt f t -> continuity_pt g t.
Proof. intros H. apply (continuity_pt_locally_ext f g 1); [lra | intros; apply H]. Qed.

Lemma continuity_constant (a t : R) : continuity_pt (fun _ => a) t.
Proof. apply continuity_pt_const. intros x y. reflexivity. Qed.

Lemma continuity_tanh (t : R) : continuity_pt tanh t.
Proof.
  assert (Hpos : 0 < cosh t) by (unfold cosh; pose proof (exp_pos t); pose proof (exp_pos (- t)); lra).
  apply (continuity_pt_div sinh cosh); [| | lra]; apply derivable_continuous_pt.
  - exists (cosh t). apply derivable_pt_lim_sinh.
  - exists (sinh t). apply derivable_pt_lim_cosh.
Qed.

(** * Lists of functions of time *)

Definition along (fs : list (R -> R)) (s : R) : list R := map (fun f => f s) fs.

(** A list that is a function of time, of one length at all times and with continuous entries. *)
Definition continuous (x : R -> list R) (t : R) : Prop :=
  exists fs, Forall (fun f => continuity_pt f t) fs /\ forall s, x s = along fs s.

(** Entries that are told one by one make such a list. *)
Lemma continuous_map {A : Type} (f : A -> R -> R) (l : list A) (t : R) :
  Forall (fun one => continuity_pt (f one) t) l -> continuous (fun s => map (fun one => f one s) l) t.
Proof.
  intros H. exists (map f l). split.
  - induction H; constructor; assumption.
  - intros s. unfold along. rewrite map_map. reflexivity.
Qed.

(** As does a continuous function of each entry of one. *)
Lemma continuous_entries (g : R -> R) (x : R -> list R) (t : R) :
  (forall v, continuity_pt g v) -> continuous x t -> continuous (fun s => map g (x s)) t.
Proof.
  intros Hg (fs & Hfs & Hx). exists (map (fun f s => g (f s)) fs). split.
  - clear Hx. induction Hfs as [| f fs Hf _ IH]; constructor; [| exact IH].
    apply (continuity_pt_comp f g); [exact Hf | apply Hg].
  - intros s. rewrite Hx. unfold along. rewrite !map_map. reflexivity.
Qed.

Lemma continuity_nth (x : R -> list R) (t : R) (i : nat) : continuous x t -> continuity_pt (fun s => nth i (x s) 0) t.
Proof.
  intros (fs & Hfs & Hx).
  apply (continuity_same (fun s => nth i (along fs s) 0)); [intros s; rewrite Hx; reflexivity |].
  clear Hx. revert i. induction Hfs as [| f fs Hf _ IH]; intros [| i]; cbn; try apply continuity_constant;
    [exact Hf | apply IH].
Qed.

Lemma continuity_dot (x y : R -> list R) (t : R) :
  continuous x t -> continuous y t -> continuity_pt (fun s => dot (x s) (y s)) t.
Proof.
  intros (fs & Hfs & Hx) (gs & Hgs & Hy).
  apply (continuity_same (fun s => dot (along fs s) (along gs s))); [intros s; rewrite Hx, Hy; reflexivity |].
  clear Hx Hy. revert gs Hgs. induction Hfs as [| f fs Hf _ IH]; intros gs Hgs; [exact (continuity_constant 0 t) |].
  destruct Hgs as [| g gs Hg Hgs]; [exact (continuity_constant 0 t) |]. cbn.
  apply (continuity_pt_plus (fun s => f s * g s)); [apply continuity_pt_mult; assumption | apply IH, Hgs].
Qed.

Lemma continuity_row (row : list R) (x : R -> list R) (t : R) :
  continuous x t -> continuity_pt (fun s => dot row (x s)) t.
Proof.
  intros Hx. apply continuity_dot; [| exact Hx]. exists (map (fun a _ => a) row). split.
  - apply Forall_map, Forall_forall. intros a _. apply continuity_constant.
  - intros s. unfold along. rewrite map_map, map_id. reflexivity.
Qed.

Lemma continuous_apply (M : list (list R)) (x : R -> list R) (t : R) :
  continuous x t -> continuous (fun s => apply M (x s)) t.
Proof.
  intros Hx. apply (continuous_map (fun row s => dot row (x s))), Forall_forall. intros row _. apply continuity_row, Hx.
Qed.

(** * The loop is continuous where it is smooth *)

Lemma continuous_affine (l : layer) (x : R -> list R) (t : R) :
  continuous x t -> continuous (fun s => affine l (x s)) t.
Proof.
  intros Hx. apply (continuous_map (fun row s => dot (map real (fst row)) (x s) + real (snd row))), Forall_forall.
  intros row _.
  apply (continuity_pt_plus (fun s => dot (map real (fst row)) (x s)));
    [apply continuity_row, Hx | apply continuity_constant].
Qed.

Lemma continuous_net (ls : list layer) (t : R) : forall x, continuous x t -> continuous (fun s => net ls (x s)) t.
Proof.
  induction ls as [| l [| l' ls] IH]; intros x Hx; [exact Hx | apply continuous_affine, Hx |].
  apply (IH (fun s => map tanh (affine l (x s)))), (continuous_entries tanh);
    [apply continuity_tanh | apply continuous_affine, Hx].
Qed.

Lemma continuity_act (s : squashing) (how : centring) (ch : channel) (w v : R) :
  continuity_pt (fun v => act s how ch v w) v.
Proof.
  assert (Hsquash : forall v, continuity_pt (squash s) v).
  { intros u. destruct s; [apply continuity_tanh | apply derivable_continuous_pt, derivable_pt_id]. }
  assert (Hscaled : forall b v, continuity_pt (fun v => real (scale ch) * squash s v + b) v).
  { intros b u. apply (continuity_pt_plus (fun v => real (scale ch) * squash s v)); [| apply continuity_constant].
    apply (continuity_pt_scal (squash s)), Hsquash. }
  destruct how; cbn.
  - apply (continuity_same
      (fun v => real (scale ch) * squash s v + (- (real (scale ch) * squash s w) + ratio (rest ch))));
      [intros; ring | apply Hscaled].
  - apply (continuity_pt_comp (fun v => v - w + artanh ((ratio (rest ch) - real (offset ch)) / real (scale ch)))
      (fun v => real (scale ch) * squash s v + real (offset ch))); [| apply Hscaled].
    apply (continuity_pt_plus (fun v => v - w)); [| apply continuity_constant].
    apply (continuity_pt_minus (fun v => v));
      [apply derivable_continuous_pt, derivable_pt_id | apply continuity_constant].
  - apply Hscaled.
Qed.

Lemma continuous_acts (s : squashing) (how : centring) (v : R -> list R) (t : R) :
  continuous v t -> forall chs w, continuous (fun r => acts s how chs (v r) w) t.
Proof.
  assert (Hnone : continuous (fun _ => []) t) by (exists []; split; [constructor | reflexivity]).
  intros (fs & Hfs & Hv) chs w.
  enough (H : continuous (fun r => acts s how chs (along fs r) w) t).
  { destruct H as (gs & Hgs & H). exists gs. split; [exact Hgs | intros r; rewrite Hv; apply H]. }
  clear Hv. revert chs w. induction Hfs as [| f fs Hf _ IH]; intros [| ch chs] [| q w]; try exact Hnone.
  destruct (IH chs w) as (gs & Hgs & H). exists ((fun r => act s how ch (f r) q) :: gs). split.
  - constructor; [| exact Hgs]. apply (continuity_pt_comp f (fun v => act s how ch v q));
      [exact Hf | apply continuity_act].
  - intros r. cbn. f_equal. apply H.
Qed.

(** An expression is continuous in time where it is defined. *)
Lemma continuity_value (x u : R -> list R) (t : R) (e : expr) :
  continuous x t -> continuous u t -> defined (x t) (u t) e -> continuity_pt (fun s => value (x s) (u s) e) t.
Proof.
  intros Hx Hu. induction e; cbn; intros He.
  - apply continuity_nth, Hx.
  - apply continuity_nth, Hu.
  - apply continuity_constant.
  - apply (continuity_pt_plus (fun s => value (x s) (u s) e1)); tauto.
  - apply (continuity_pt_opp (fun s => value (x s) (u s) e)); tauto.
  - apply (continuity_pt_mult (fun s => value (x s) (u s) e1)); tauto.
  - apply (continuity_pt_inv (fun s => value (x s) (u s) e)); tauto.
  - apply (continuity_pt_comp (fun s => value (x s) (u s) e) (fun v => v ^ k)); [tauto |].
    apply derivable_continuous_pt, derivable_pt_pow.
  - apply (continuity_pt_comp (fun s => value (x s) (u s) e) sin); [tauto | apply continuity_sin].
  - apply (continuity_pt_comp (fun s => value (x s) (u s) e) cos); [tauto | apply continuity_cos].
  - apply (continuity_pt_comp (fun s => value (x s) (u s) e) tanh); [tauto | apply continuity_tanh].
  - apply (continuity_pt_comp (fun s => value (x s) (u s) e) exp); [tauto |].
    apply derivable_continuous_pt, derivable_pt_exp.
  - apply (continuity_pt_comp (fun s => value (x s) (u s) e) atan); [tauto |].
    apply derivable_continuous_pt, derivable_pt_atan.
  - apply (continuity_pt_comp (fun s => value (x s) (u s) e) sqrt); [tauto | apply sqrt_continuity_pt; tauto].
Qed.

Section Certificate.
Variable c : certificate.

(** V is continuous wherever the state is, and its derivative where the plant is smooth. *)
Lemma continuity_V (x : R -> list R) (t : R) : continuous x t -> continuity_pt (fun s => V c (x s)) t.
Proof. intros Hx. apply continuity_dot; [exact Hx | apply continuous_apply, Hx]. Qed.

Lemma continuity_Vdot (x : R -> list R) (t : R) :
  continuous x t -> Forall (defined (x t) (policy c (x t))) (field c) -> continuity_pt (fun s => Vdot c (x s)) t.
Proof.
  intros Hx Hsmooth. apply (continuity_pt_scal (fun s => dot (apply (matrix c) (x s)) (F c (x s)))).
  apply continuity_dot; [apply continuous_apply, Hx |].
  apply (continuous_map (fun e s => value (x s) (policy c (x s)) e)). revert Hsmooth. apply Forall_impl. intros e.
  apply (continuity_value x (fun s => policy c (x s))); [exact Hx | apply continuous_acts, continuous_net, Hx].
Qed.
End Certificate.

(** * The derivative of V *)

(** The sum of the first n. *)
Fixpoint sum (n : nat) (f : nat -> R) : R := match n with O => 0 | S n => f O + sum n (fun i => f (S i)) end.

Lemma sum_same (n : nat) : forall f g, (forall i, (i < n)%nat -> f i = g i) -> sum n f = sum n g.
Proof.
  induction n as [| n IH]; intros f g H; cbn; [reflexivity |].
  rewrite (H O), (IH (fun i => f (S i)) (fun i => g (S i))); [reflexivity | intros i Hi; apply H; lia | lia].
Qed.

Lemma sum_plus (n : nat) : forall f g, sum n (fun i => f i + g i) = sum n f + sum n g.
Proof.
  induction n as [| n IH]; intros f g; cbn; [ring |]. rewrite (IH (fun i => f (S i)) (fun i => g (S i))). ring.
Qed.

Lemma sum_times (n : nat) (a : R) : forall f, sum n (fun i => a * f i) = a * sum n f.
Proof. induction n as [| n IH]; intros f; cbn; [ring |]. rewrite (IH (fun i => f (S i))). ring. Qed.

(** The order of two sums does not matter. *)
Lemma sum_swap (n m : nat) : forall f : nat -> nat -> R,
  sum n (fun i => sum m (f i)) = sum m (fun j => sum n (fun i => f i j)).
Proof.
  induction n as [| n IH]; intros f; cbn.
  - rewrite (sum_same m _ (fun i => 0 * 0)), sum_times; [ring | intros; ring].
  - rewrite (IH (fun i => f (S i))), <- sum_plus. reflexivity.
Qed.

Lemma dot_sum : forall a b n, length a = n -> length b = n -> dot a b = sum n (fun i => nth i a 0 * nth i b 0).
Proof.
  induction a as [| p a IH]; intros b n <- Hb; [reflexivity |]. destruct b as [| q b]; [discriminate |].
  cbn. f_equal. apply IH; [reflexivity | injection Hb as Hb; exact Hb].
Qed.

Lemma apply_nth (M : list (list R)) (x : list R) (i : nat) : nth i (apply M x) 0 = dot (nth i M []) x.
Proof. apply (map_nth (fun row => dot row x) M []). Qed.

(** a'M b, written out. *)
Lemma bilinear (n : nat) (M : list (list R)) (a b : list R) : square n M -> length a = n -> length b = n ->
  dot a (apply M b) = sum n (fun i => sum n (fun j => nth i a 0 * (nth j (nth i M []) 0 * nth j b 0))).
Proof.
  intros [Hn Hrows] Ha Hb. rewrite (dot_sum a _ n Ha); [| unfold apply; rewrite map_length; exact Hn].
  apply sum_same. intros i Hi. rewrite apply_nth, sum_times. f_equal. apply dot_sum; [| exact Hb].
  apply (proj1 (Forall_forall _ M) Hrows), nth_In. rewrite Hn. exact Hi.
Qed.

(** a'M b = b'M a for a symmetric M. *)
Lemma bilinear_symmetric (n : nat) (M : list (list R)) (a b : list R) :
  square n M -> symmetric M -> length a = n -> length b = n ->
  dot a (apply M b) = dot b (apply M a).
Proof.
  intros HM Hsym Ha Hb. rewrite (bilinear n M a b), (bilinear n M b a), sum_swap by assumption.
  apply sum_same. intros j Hj. apply sum_same. intros i Hi.
  rewrite (Hsym i j); [ring | |]; destruct HM as [-> _]; assumption.
Qed.

Definition derivatives (fs : list (R -> R)) (t : R) (ds : list R) : Prop :=
  Forall2 (fun f d => derivable_pt_lim f t d) fs ds.

(** The product rule for lists. *)
Lemma derivative_dot (t : R) : forall fs ds gs es, derivatives fs t ds -> derivatives gs t es ->
  derivable_pt_lim (fun s => dot (along fs s) (along gs s)) t (dot ds (along gs t) + dot (along fs t) es).
Proof.
  intros fs ds gs es Hfs. revert gs es. induction Hfs as [| f d fs ds Hf _ IH]; intros gs es Hgs; cbn.
  - rewrite Rplus_0_r. apply derivable_pt_lim_const.
  - destruct Hgs as [| g e gs es Hg Hgs]; cbn; [rewrite Rplus_0_r; apply derivable_pt_lim_const |].
    fold (along fs t) (along gs t). replace (d * g t + dot ds (along gs t) + (f t * e + dot (along fs t) es))
      with (d * g t + f t * e + (dot ds (along gs t) + dot (along fs t) es)) by ring.
    apply (derivable_pt_lim_plus (fun s => f s * g s)); [apply derivable_pt_lim_mult; assumption | apply IH, Hgs].
Qed.

Lemma derivative_row (t : R) (fs : list (R -> R)) (ds : list R) :
  derivatives fs t ds -> forall row, derivable_pt_lim (fun s => dot row (along fs s)) t (dot row ds).
Proof.
  intros Hfs. induction Hfs as [| f d fs ds Hf _ IH]; intros [| r row]; cbn; try apply derivable_pt_lim_const.
  apply (derivable_pt_lim_plus (fun s => r * f s)); [apply (derivable_pt_lim_scal f), Hf | apply IH].
Qed.

(** (x'M x)' = 2 (M x)'x' for a symmetric M. *)
Lemma derivative_form (n : nat) (M : list (list R)) (fs : list (R -> R)) (ds : list R) (t : R) :
  square n M -> symmetric M -> length fs = n -> length ds = n -> derivatives fs t ds ->
  derivable_pt_lim (fun s => form M (along fs s)) t (2 * dot (apply M (along fs t)) ds).
Proof.
  intros HM Hsym Hfs Hds H.
  assert (Hrows : derivatives (map (fun row s => dot row (along fs s)) M) t (apply M ds)).
  { clear HM Hsym. induction M; constructor; [apply derivative_row, H | assumption]. }
  assert (Happly : forall s, apply M (along fs s) = along (map (fun row s => dot row (along fs s)) M) s).
  { intros s. unfold along at 2. rewrite map_map. reflexivity. }
  pose proof (derivative_dot t _ _ _ _ H Hrows) as HV. rewrite <- Happly in HV.
  rewrite (bilinear_symmetric n M (along fs t) ds) in HV;
    [| exact HM | exact Hsym | unfold along; rewrite map_length; exact Hfs | exact Hds].
  rewrite (dot_comm (apply M (along fs t)) ds).
  replace (2 * _) with (dot ds (apply M (along fs t)) + dot ds (apply M (along fs t))) by ring.
  revert HV. apply derivable_pt_lim_ext. intros s. unfold form. rewrite Happly. reflexivity.
Qed.

(** A list is that of its entries. *)
Lemma entries (a : list R) : a = map (fun i => nth i a 0) (seq 0 (length a)).
Proof.
  induction a as [| p a IH]; [reflexivity |]. cbn. f_equal. rewrite <- seq_shift, map_map. exact IH.
Qed.

Lemma entries_along (x : R -> list R) (n : nat) :
  (forall s, length (x s) = n) -> forall s, x s = along (map (fun i s => nth i (x s) 0) (seq 0 n)) s.
Proof. intros Hn s. unfold along. rewrite map_map, <- (Hn s). apply entries. Qed.

(** * Functions of one variable *)

(** The mean value theorem, where a derivative is needed between the ends alone. *)
Lemma mean_value_within (f f' : R -> R) (a b : R) : a < b -> (forall t, continuity_pt f t) ->
  (forall t, a < t < b -> derivable_pt_lim f t (f' t)) -> exists t, a < t < b /\ f b - f a = f' t * (b - a).
Proof.
  intros Hab Hf Hd.
  destruct (MVT f id a b (fun t Ht => exist _ (f' t) (Hd t Ht)) (fun t _ => derivable_pt_id t) Hab) as (t & Ht & H).
  - intros t _. apply Hf.
  - intros t _. apply derivable_continuous_pt, derivable_pt_id.
  - exists t. split; [exact Ht |]. rewrite derive_pt_id in H. cbn in H. unfold id in H. lra.
Qed.

(** A continuous function that gets above a level was at most there at some last time. *)
Lemma last_below (v : R -> R) (l b : R) : 0 < b -> (forall t, continuity_pt v t) -> v 0 <= l -> l < v b ->
  exists m, 0 <= m < b /\ v m <= l /\ forall s, m < s <= b -> l < v s.
Proof.
  intros Hb Hv H0 Hl.
  destruct (completeness (fun s => 0 <= s <= b /\ v s <= l)) as (m & Hup & Hleast).
  - exists b. intros s [Hs _]. lra.
  - exists 0. lra.
  - assert (Hm : 0 <= m <= b) by (split; [apply Hup; lra | apply Hleast; intros s [Hs _]; lra]).
    assert (Hvm : v m <= l).
    { destruct (Rle_or_lt (v m) l) as [H | H]; [exact H | exfalso].
      destruct (stays_below (fun s => - v s) m (- l)) as (delta & Hd & Hnear);
        [apply (continuity_pt_opp v), Hv | lra |].
      assert (m <= m - delta); [| lra]. apply Hleast. intros s [Hs Hvs]. specialize (Hup s (conj Hs Hvs)).
      destruct (Rle_or_lt s (m - delta)) as [Hd' | Hd']; [exact Hd' | exfalso].
      assert (- v s < - l); [| lra]. apply Hnear, Rabs_def1; lra. }
    exists m. split; [| split; [exact Hvm |]].
    + split; [lra |]. destruct (Req_dec m b) as [-> |]; lra.
    + intros s Hs. destruct (Rle_or_lt (v s) l) as [H | H]; [exfalso | exact H].
      assert (s <= m) by (apply Hup; lra). lra.
Qed.

(** * Trajectories *)

(** The sum of the absolute values. *)
Fixpoint size (a : list R) : R := match a with [] => 0 | p :: a => Rabs p + size a end.

Lemma size_nonnegative (a : list R) : 0 <= size a.
Proof. induction a as [| p a IH]; cbn; [lra |]. pose proof (Rabs_pos p). lra. Qed.

Lemma dot_small (d : R) : 0 <= d -> forall a x, Forall (fun v => Rabs v <= d) x -> Rabs (dot a x) <= size a * d.
Proof.
  intros Hd. induction a as [| p a IH]; intros x Hx; cbn; [rewrite Rabs_R0; lra |]. destruct Hx as [| v x Hv Hx].
  - rewrite Rabs_R0. apply Rmult_le_pos; [| exact Hd]. pose proof (Rabs_pos p). pose proof (size_nonnegative a). lra.
  - apply (Rle_trans _ _ _ (Rabs_triang _ _)). specialize (IH x Hx). rewrite Rabs_mult.
    pose proof (Rmult_le_compat_l _ _ _ (Rabs_pos p) Hv). lra.
Qed.

(** A form is small near the origin. *)
Lemma form_small (M : list (list R)) : exists k, 0 < k /\
  forall d x, 0 <= d -> Forall (fun v => Rabs v <= d) x -> form M x <= k * d ^ 2.
Proof.
  enough (H : exists k, 0 < k /\ forall d x, 0 <= d -> Forall (fun v => Rabs v <= d) x -> size (apply M x) <= k * d).
  { destruct H as (k & Hk & H). exists k. split; [exact Hk |]. intros d x Hd Hx. unfold form. rewrite dot_comm.
    apply (Rle_trans _ _ _ (Rle_abs _)), (Rle_trans _ _ _ (dot_small d Hd _ x Hx)).
    replace (k * d ^ 2) with (k * d * d) by ring. apply Rmult_le_compat_r; auto. }
  induction M as [| row M (k & Hk & IH)].
  { exists 1. split; [lra |]. intros d x Hd _. change (0 <= 1 * d). lra. }
  exists (size row + k). pose proof (size_nonnegative row). split; [lra |]. intros d x Hd Hx.
  change (Rabs (dot row x) + size (apply M x) <= (size row + k) * d).
  pose proof (dot_small d Hd row x Hx). specialize (IH d x Hd Hx). lra.
Qed.

Section Trajectories.
Variable c : certificate.
Variable rate : R.

(** What is asked of the certificate. The level is above 0: at 0 the set is the origin alone, and that nothing leaves it
    would need unique solutions. The plant is smooth: from the edge of the set, beyond which nothing is shown of it, a
    solution falls back by continuity. *)
Hypothesis fits : length (field c) = states c /\ square (states c) (P c).
Hypothesis symmetric_P : symmetric (matrix c).
Hypothesis positive_level : 0 < real (level c).
Hypothesis smooth_inside : forall x, inside c x -> Forall (defined x (policy c x)) (field c).
Hypothesis decreasing : forall x, inside c x -> x <> zeros (states c) -> Vdot c x < 0 /\ Vdot c x + rate * V c x <= 0.

Lemma V_zeros : V c (zeros (states c)) = 0.
Proof. unfold V, form. rewrite dot_comm. apply dot_zeros. Qed.

(** At the origin V and its derivative are both 0. *)
Lemma decreasing_everywhere (x : list R) : inside c x -> Vdot c x + rate * V c x <= 0.
Proof.
  intros Hx. destruct (list_eq_dec Req_EM_T x (zeros (states c))) as [-> | Hne]; [| apply decreasing; assumption].
  assert (H : apply (matrix c) (zeros (states c)) = map (fun _ => 0) (matrix c)).
  { apply map_ext. intros row. apply dot_zeros. }
  assert (H0 : forall (l : list (list R)) b, dot (map (fun _ => 0) l) b = 0).
  { induction l as [| r l IH]; intros [| q b]; cbn; try reflexivity. rewrite IH. ring. }
  rewrite V_zeros. unfold Vdot. rewrite H, H0. lra.
Qed.

(** A path that is continuous at all times and obeys the loop from 0 to b, both left out. *)
Definition path (y : R -> list R) (b : R) : Prop :=
  (forall t, length (y t) = states c)
  /\ (forall i, (i < states c)%nat -> forall t, continuity_pt (fun s => nth i (y s) 0) t)
  /\ (forall i, (i < states c)%nat -> forall t, 0 < t < b ->
      derivable_pt_lim (fun s => nth i (y s) 0) t (nth i (F c (y t)) 0)).

Lemma path_continuous (y : R -> list R) (b t : R) : path y b -> continuous y t.
Proof.
  intros (Hn & Hy & _). exists (map (fun i s => nth i (y s) 0) (seq 0 (states c))). split; [| apply entries_along, Hn].
  apply Forall_map, Forall_forall. intros i Hi. apply in_seq in Hi. apply Hy. lia.
Qed.

(** Along it V has the derivative Vdot. *)
Lemma derivative_V (y : R -> list R) (b t : R) :
  path y b -> 0 < t < b -> derivable_pt_lim (fun s => V c (y s)) t (Vdot c (y t)).
Proof.
  intros (Hn & _ & Hd) Ht. destruct fits as [Hfield [HP Hrows]]. pose proof (entries_along y (states c) Hn) as Hy.
  set (fs := map _ _) in Hy.
  assert (HF : length (F c (y t)) = states c) by (unfold F; rewrite map_length; exact Hfield).
  apply (derivable_pt_lim_ext (fun s => V c (along fs s))); [intros s; rewrite <- Hy; reflexivity |].
  unfold Vdot. rewrite (Hy t) at 1. apply (derivative_form (states c)); [| exact symmetric_P | | exact HF |].
  - split; [unfold matrix; rewrite map_length; exact HP |]. unfold matrix. apply Forall_map.
    revert Hrows. apply Forall_impl. intros row Hrow. rewrite map_length. exact Hrow.
  - unfold fs. rewrite map_length, seq_length. reflexivity.
  - unfold derivatives, fs. rewrite (entries (F c (y t))), HF. clear Hy fs.
    assert (Hall : Forall (fun i => (i < states c)%nat) (seq 0 (states c))).
    { apply Forall_forall. intros i Hi. apply in_seq in Hi. lia. }
    induction Hall as [| i l Hi _ IH]; cbn; [constructor |]. constructor; [apply Hd; assumption | exact IH].
Qed.

(** It stays inside: when V is at most the level for the last time, it falls, or the state is at the origin, where V is
    below the level. *)
Lemma path_inside (y : R -> list R) (b : R) :
  path y b -> 0 < b -> V c (y 0) <= real (level c) -> V c (y b) <= real (level c).
Proof.
  intros Hy Hb H0. destruct (Rle_or_lt (V c (y b)) (real (level c))) as [H | H]; [exact H | exfalso].
  assert (Hv : forall t, continuity_pt (fun s => V c (y s)) t)
    by (intros t; apply continuity_V, (path_continuous y b), Hy).
  destruct (last_below (fun s => V c (y s)) (real (level c)) b Hb Hv H0 H) as (m & Hm & Hvm & Habove). cbn beta in *.
  assert (Hinside : inside c (y m)) by (split; [apply Hy | exact Hvm]).
  assert (Hstep : forall delta, 0 < delta -> exists s, m < s <= b /\ s - m < delta).
  { intros delta Hd. exists (m + Rmin (delta / 2) (b - m)).
    pose proof (Rmin_l (delta / 2) (b - m)). pose proof (Rmin_r (delta / 2) (b - m)).
    assert (0 < Rmin (delta / 2) (b - m)) by (apply Rmin_glb_lt; lra). lra. }
  destruct (list_eq_dec Req_EM_T (y m) (zeros (states c))) as [Hzero | Hne].
  - destruct (stays_below (fun s => V c (y s)) m (real (level c)) (Hv m)) as (delta & Hd & Hnear);
      [rewrite Hzero, V_zeros; lra |].
    destruct (Hstep delta Hd) as (s & Hs & Hsm). specialize (Habove s Hs).
    assert (V c (y s) < real (level c)); [apply Hnear, Rabs_def1; lra | lra].
  - destruct (stays_below (fun s => Vdot c (y s)) m 0) as (delta & Hd & Hnear);
      [apply continuity_Vdot; [apply (path_continuous y b), Hy | apply smooth_inside, Hinside] |
       apply decreasing; assumption |].
    destruct (Hstep delta Hd) as (s & Hs & Hsm). specialize (Habove s Hs).
    destruct (mean_value_within (fun s => V c (y s)) (fun s => Vdot c (y s)) m s) as (r & Hr & Hmean);
      [lra | exact Hv | intros r Hr; apply (derivative_V y b); [exact Hy | lra] |].
    assert (Hfall : Vdot c (y r) < 0) by (apply Hnear, Rabs_def1; lra).
    pose proof (Rmult_lt_compat_r (s - m) _ _ ltac:(lra) Hfall) as Hproduct. cbn beta in *. lra.
Qed.

(** As V exp(rate t) does not grow, V falls at the rate. *)
Lemma path_decays (y : R -> list R) (b : R) : path y b -> 0 < b -> V c (y 0) <= real (level c) ->
  V c (y b) <= V c (y 0) * exp (- rate * b).
Proof.
  intros Hy Hb H0.
  assert (Hexp : forall t, derivable_pt_lim (fun s => exp (rate * s)) t (exp (rate * t) * rate)).
  { intros t. apply (derivable_pt_lim_comp (fun s => rate * s) exp); [| apply derivable_pt_lim_exp].
    pose proof (derivable_pt_lim_scal id rate t 1 (derivable_pt_lim_id t)) as H. rewrite Rmult_1_r in H. exact H. }
  destruct (mean_value_within (fun s => V c (y s) * exp (rate * s))
    (fun t => Vdot c (y t) * exp (rate * t) + V c (y t) * (exp (rate * t) * rate)) 0 b Hb) as (t & Ht & Hmean).
  - intros t. apply (continuity_pt_mult (fun s => V c (y s))); [apply continuity_V, (path_continuous y b), Hy |].
    apply derivable_continuous_pt. exists (exp (rate * t) * rate). apply Hexp.
  - intros t Ht. apply (derivable_pt_lim_mult (fun s => V c (y s)) (fun s => exp (rate * s)));
      [apply (derivative_V y b); assumption | apply Hexp].
  - assert (Hinside : inside c (y t)).
    { split; [apply Hy |]. apply path_inside; [| lra | exact H0].
      destruct Hy as (Hn & Hc & Hd). repeat split; try assumption. intros i Hi s Hs. apply Hd; [exact Hi | lra]. }
    assert (Hfall : (Vdot c (y t) + rate * V c (y t)) * (exp (rate * t) * b) <= 0).
    { rewrite <- (Rmult_0_l (exp (rate * t) * b)). apply Rmult_le_compat_r; [| apply decreasing_everywhere, Hinside].
      apply Rlt_le, Rmult_lt_0_compat; [apply exp_pos | exact Hb]. }
    cbn beta in Hmean. rewrite Rmult_0_r, exp_0 in Hmean.
    replace (V c (y b)) with (V c (y b) * exp (rate * b) * exp (- rate * b)).
    + apply Rmult_le_compat_r; [apply Rlt_le, exp_pos | lra].
    + rewrite Rmult_assoc, <- exp_plus. replace (rate * b + - rate * b) with 0 by ring. rewrite exp_0. ring.
Qed.

(** A time held between 0 and b. *)
Definition held (b t : R) : R := Rmax 0 (Rmin t b).

(** A solution, standing still before 0 and after b, is such a path. *)
Lemma solution_path (x : R -> list R) (T b : R) : solution c x T -> 0 < b < T -> path (fun t => x (held b t)) b.
Proof.
  intros (Hn & Hstart & Hd) Hb.
  assert (Hheld : forall t, 0 <= held b t <= b).
  { intros t. split; [apply Rmax_l |]. apply Rmax_lub; [lra | apply Rmin_r]. }
  assert (Hbetween : forall t, 0 <= t <= b -> held b t = t).
  { intros t Ht. unfold held. rewrite Rmin_left, Rmax_right; lra. }
  assert (Hclose : forall s t, Rabs (held b s - held b t) <= Rabs (s - t)).
  { intros s t. unfold held, Rmax, Rmin, Rabs. repeat destruct Rle_dec; repeat destruct Rcase_abs; lra. }
  split; [| split]; cbn beta.
  - intros t. apply Hn. specialize (Hheld t). lra.
  - intros i Hi t. apply continuity_near. intros eps Heps. destruct (Hheld t) as [Hlow Hhigh].
    destruct (Rle_lt_or_eq_dec _ _ Hlow) as [Hpos | Hzero].
    + assert (Hcont : continuity_pt (fun s => nth i (x s) 0) (held b t)).
      { apply derivable_continuous_pt. exists (nth i (F c (x (held b t))) 0). apply Hd; [exact Hi | lra]. }
      destruct (proj1 (continuity_near _ _) Hcont eps Heps) as (delta & Hdelta & H). exists delta.
      split; [exact Hdelta |].
      intros s Hs. apply H. apply (Rle_lt_trans _ _ _ (Hclose s t) Hs).
    + rewrite <- Hzero. destruct (Hstart i Hi eps Heps) as (delta & Hdelta & H). exists delta. split; [exact Hdelta |].
      intros s Hs. destruct (Hheld s) as [Hlow' Hhigh']. destruct (Rle_lt_or_eq_dec _ _ Hlow') as [Hpos' | <-].
      * apply H; [lra |]. pose proof (Hclose s t) as Hnear.
        rewrite <- Hzero, Rminus_0_r, (Rabs_pos_eq _ Hlow') in Hnear. lra.
      * rewrite Rminus_diag_eq, Rabs_R0; [exact Heps | reflexivity].
  - intros i Hi t Ht. rewrite (Hbetween t) by lra.
    apply (derivable_pt_lim_locally_ext (fun s => nth i (x s) 0) _ t 0 b); [exact Ht | | apply Hd; [exact Hi | lra]].
    intros s Hs. rewrite Hbetween by lra. reflexivity.
Qed.

(** No trajectory leaves {V <= c2}, and V falls at the rate. *)
Theorem trajectories_decay (x : R -> list R) (T : R) : 0 < T -> solution c x T -> V c (x 0) <= real (level c) ->
  forall t, 0 <= t < T -> inside c (x t) /\ V c (x t) <= V c (x 0) * exp (- rate * t).
Proof.
  intros HT Hx H0 t [Hlow Hhigh]. destruct (Rle_lt_or_eq_dec _ _ Hlow) as [Hpos | <-].
  - pose proof (solution_path x T t Hx (conj Hpos Hhigh)) as Hpath.
    assert (Hstart : held t 0 = 0) by (unfold held; rewrite Rmin_left, Rmax_left; lra).
    assert (Hend : held t t = t) by (unfold held; rewrite Rmin_left, Rmax_right; lra).
    pose proof (path_inside _ t Hpath Hpos) as Hin. pose proof (path_decays _ t Hpath Hpos) as Hdecay.
    cbn beta in Hin, Hdecay. rewrite Hstart, Hend in Hin, Hdecay.
    split; [split; [apply Hx; lra |] |]; auto.
  - split; [split; [apply Hx; lra | exact H0] |]. rewrite Rmult_0_r, exp_0. lra.
Qed.

(** The bounds of several states have one in common. *)
Lemma common_bound (n : nat) :
  (forall i, (i < n)%nat -> exists b, 0 < b /\
    forall x, length x = states c -> real (level c) * nth i x 0 ^ 2 <= b ^ 2 * V c x) ->
  exists b, 0 < b /\ forall i, (i < n)%nat ->
    forall x, length x = states c -> real (level c) * nth i x 0 ^ 2 <= b ^ 2 * V c x.
Proof.
  induction n as [| n IH]; intros H; [exists 1; split; [lra | intros; lia] |].
  destruct IH as (b & Hb & Hbound); [intros i Hi; apply H; lia |]. destruct (H n) as (d & Hd & Hlast); [lia |].
  exists (b + d). split; [lra |]. intros i Hi x Hx. specialize (Hlast x Hx).
  assert (HV : 0 <= V c x).
  { apply (Rmult_le_reg_l (d ^ 2)); [apply pow_lt, Hd |]. rewrite Rmult_0_r. refine (Rle_trans _ _ _ _ Hlast).
    apply Rmult_le_pos; [lra | apply pow2_ge_0]. }
  assert (Hcross : 0 <= b * d * V c x) by (repeat apply Rmult_le_pos; lra).
  pose proof (Rmult_le_pos _ _ (pow2_ge_0 b) HV). pose proof (Rmult_le_pos _ _ (pow2_ge_0 d) HV).
  replace ((b + d) ^ 2 * V c x) with (b ^ 2 * V c x + d ^ 2 * V c x + 2 * (b * d * V c x)) by ring.
  destruct (Nat.eq_dec i n) as [-> | Hne]; [lra |]. specialize (Hbound i ltac:(lia) x Hx). lra.
Qed.

(** Asymptotic stability in the usual words, for solutions at all times: those that start near the origin stay near it,
    and all that start in the set come near it, together. *)
Theorem trajectories_converge : 0 < rate ->
  (forall i, (i < states c)%nat -> exists b, 0 < b /\
    forall x, length x = states c -> real (level c) * nth i x 0 ^ 2 <= b ^ 2 * V c x) ->
  forall eps, 0 < eps ->
  (exists delta, 0 < delta /\ forall x, (forall T, 0 < T -> solution c x T) ->
    (forall i, (i < states c)%nat -> Rabs (nth i (x 0) 0) < delta) ->
    forall t, 0 <= t -> forall i, (i < states c)%nat -> Rabs (nth i (x t) 0) < eps)
  /\ (exists time, 0 <= time /\ forall x, (forall T, 0 < T -> solution c x T) -> V c (x 0) <= real (level c) ->
    forall t, time <= t -> forall i, (i < states c)%nat -> Rabs (nth i (x t) 0) < eps).
Proof.
  intros Hrate Hbounds eps Heps. destruct (common_bound _ Hbounds) as (b & Hb & Hbound).
  assert (Hb2 : 0 < b ^ 2) by (apply pow_lt, Hb). assert (Heps2 : 0 < eps ^ 2) by (apply pow_lt, Heps).
  assert (Hcoordinate : forall x t i, (forall T, 0 < T -> solution c x T) -> V c (x 0) <= real (level c) -> 0 <= t ->
    (i < states c)%nat -> b ^ 2 * (V c (x 0) * exp (- rate * t)) < real (level c) * eps ^ 2 ->
    Rabs (nth i (x t) 0) < eps).
  { intros x t i Hx H0 Ht Hi Hsmall.
    destruct (trajectories_decay x (t + 1) ltac:(lra) (Hx (t + 1) ltac:(lra)) H0 t ltac:(lra)) as [[Hn _] Hdecay].
    specialize (Hbound i Hi (x t) Hn). apply (Rmult_le_compat_l (b ^ 2)) in Hdecay; [| lra].
    rewrite <- (Rabs_pos_eq eps) by lra. apply Rsqr_lt_abs_0. rewrite !Rsqr_pow2.
    apply (Rmult_lt_reg_l (real (level c))); [exact positive_level | lra]. }
  split.
  - destruct (form_small (matrix c)) as (k & Hk & Hform).
    set (q := Rmin (real (level c)) (real (level c) * eps ^ 2 / (2 * b ^ 2))).
    assert (Hhalf : b ^ 2 * (real (level c) * eps ^ 2 / (2 * b ^ 2)) = real (level c) * eps ^ 2 / 2) by (field; lra).
    assert (Hpos : 0 < real (level c) * eps ^ 2) by (apply Rmult_lt_0_compat; assumption).
    assert (Hq : 0 < q) by (apply Rmin_glb_lt; [exact positive_level | apply Rdiv_lt_0_compat; lra]).
    exists (sqrt (q / k)). split; [apply sqrt_lt_R0, Rdiv_lt_0_compat; assumption |]. intros x Hx Hnear t Ht i Hi.
    destruct (Hx 1 ltac:(lra)) as [Hn _]. specialize (Hn 0 ltac:(lra)).
    assert (Hq0 : V c (x 0) <= q).
    { replace q with (k * sqrt (q / k) ^ 2);
        [| rewrite pow2_sqrt; [field; lra | apply Rlt_le, Rdiv_lt_0_compat; assumption]].
      apply Hform; [apply sqrt_pos | apply Forall_forall]. intros v Hv. destruct (In_nth _ _ 0 Hv) as (j & Hj & <-).
      rewrite Hn in Hj. apply Rlt_le, Hnear, Hj. }
    assert (HV0 : 0 <= V c (x 0)).
    { apply (Rmult_le_reg_l (b ^ 2)); [exact Hb2 |]. rewrite Rmult_0_r.
      refine (Rle_trans _ _ _ _ (Hbound i Hi (x 0) Hn)).
      apply Rmult_le_pos; [lra | apply pow2_ge_0]. }
    assert (Hle1 : exp (- rate * t) <= 1).
    { rewrite <- exp_0. pose proof (Rmult_le_pos rate t ltac:(lra) Ht). destruct (Req_dec (rate * t) 0) as [Hz | Hnz].
      - replace (- rate * t) with 0 by lra. lra.
      - apply Rlt_le, exp_increasing. lra. }
    apply Hcoordinate; try assumption; [apply (Rle_trans _ _ _ Hq0), Rmin_l |].
    apply (Rle_lt_trans _ (real (level c) * eps ^ 2 / 2)); [| lra]. rewrite <- Hhalf.
    apply Rmult_le_compat_l; [lra |]. apply (Rle_trans _ (V c (x 0) * 1)); [apply Rmult_le_compat_l; assumption |].
    rewrite Rmult_1_r. apply (Rle_trans _ _ _ Hq0), Rmin_r.
  - exists (b ^ 2 / (eps ^ 2 * rate)).
    assert (Htime : 0 < b ^ 2 / (eps ^ 2 * rate))
      by (apply Rdiv_lt_0_compat; [exact Hb2 | apply Rmult_lt_0_compat; assumption]).
    split; [lra |]. intros x Hx H0 t Ht i Hi. apply Hcoordinate; try assumption; [lra |].
    assert (Hgrown : b ^ 2 < eps ^ 2 * exp (rate * t)).
    { apply (Rle_lt_trans _ (eps ^ 2 * (rate * t))).
      - apply (Rmult_le_compat_l (eps ^ 2 * rate)) in Ht; [| apply Rmult_le_pos; lra].
        replace (eps ^ 2 * rate * (b ^ 2 / (eps ^ 2 * rate))) with (b ^ 2) in Ht by (field; lra). lra.
      - apply Rmult_lt_compat_l; [exact Heps2 |]. pose proof (exp_ineq1 (rate * t)) as H.
        pose proof (Rmult_lt_0_compat rate t Hrate ltac:(lra)). specialize (H ltac:(lra)). lra. }
    pose proof (exp_pos (- rate * t)) as He.
    assert (Hfallen : b ^ 2 * exp (- rate * t) < eps ^ 2).
    { apply (Rmult_lt_compat_r (exp (- rate * t))) in Hgrown; [| exact He].
      rewrite (Rmult_assoc (eps ^ 2)), <- exp_plus in Hgrown.
      replace (rate * t + - rate * t) with 0 in Hgrown by ring. rewrite exp_0 in Hgrown. lra. }
    apply (Rle_lt_trans _ (real (level c) * (b ^ 2 * exp (- rate * t)))); [| apply Rmult_lt_compat_l; assumption].
    rewrite <- Rmult_assoc, (Rmult_comm (b ^ 2)), Rmult_assoc. apply Rmult_le_compat_r; [| exact H0].
    apply Rmult_le_pos; lra.
Qed.
End Trajectories.
