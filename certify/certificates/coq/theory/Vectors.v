(** Vectors and matrices as lists of real numbers, and positive definite forms. *)
From Coq Require Import Reals List Lra Lia.
Import ListNotations.
Open Scope R_scope.

Fixpoint dot (a b : list R) : R :=
  match a, b with
  | p :: a, q :: b => p * q + dot a b
  | _, _ => 0
  end.

(** A matrix is the list of its rows. *)
Definition apply (M : list (list R)) (x : list R) : list R := map (fun row => dot row x) M.

(** x'M x *)
Definition form (M : list (list R)) (x : list R) : R := dot x (apply M x).

Definition square (n : nat) {A : Type} (M : list (list A)) : Prop := length M = n /\ Forall (fun row => length row = n) M.

Definition symmetric (M : list (list R)) : Prop :=
  forall i j, (i < length M)%nat -> (j < length M)%nat -> nth j (nth i M []) 0 = nth i (nth j M []) 0.

Definition zeros (n : nat) : list R := repeat 0 n.

(** Two facts, for the proofs. *)
Lemma dot_comm a : forall b, dot a b = dot b a.
Proof. induction a; intros [|q b]; simpl; auto. rewrite IHa. ring. Qed.

Lemma dot_zeros n : forall a, dot a (zeros n) = 0.
Proof. induction n; intros [|p a]; simpl; auto. fold (zeros n). rewrite IHn. ring. Qed.
