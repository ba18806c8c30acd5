(** What a proof is led by. Nobody believes it: whatever stands here, `Check.check` says true of nothing false.

    States are looked at in coordinates z with x = T z, z = W x, where T W = W T = I exactly. In them the set of the claim lies in
    the box |z_i| <= root_i, which the tree divides. *)
From Coq Require Import List Floats.
Require Import Spec.

(** Splits of a box, the half below the number first. On a leaf, what is shown is that Vdot + rate V + k (c2 - V) < 0 on
    all of it, k >= 0 the leaf's number, or else that all of it lies outside of the set, or within the core. *)
Inductive tree :=
  | Leaf (k : float)
  | Split (axis : nat) (at_ : float) (below above : tree).

Record evidence := Evidence {
  T : list (list rational);
  W : list (list rational);
  root : list float;
  core : list float;  (** |z_i| <= core_i is where F is compared with its slopes from the origin *)
  splits : tree
}.
