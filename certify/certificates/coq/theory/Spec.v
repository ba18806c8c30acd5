(** What is claimed, in real numbers alone.

    A reader who wants to know what was proved reads this file, the few definitions of `Vectors.v`, and the data file of the
    certificate: no interval, no floating point number and no search occurs in them.

    What is said of solutions is said of every solution there is. That there is one, that it is the only one and that it
    lasts for ever is the classical theorem of Picard and Lindeloef for a smooth field on a compact set that is not left
    (`smooth`, `trajectories`), and is not proved again here. *)
From Coq Require Import Reals List ZArith.
Require Import Vectors.
Import ListNotations.
Open Scope R_scope.

(** * Numbers *)

(** A binary64 number, exactly: a mantissa times a power of two. *)
Record dyadic := Dyadic { mantissa : Z; exponent : Z }.
Definition real (d : dyadic) : R := IZR (mantissa d) * powerRZ 2 (exponent d).

Record rational := Ratio { numerator : Z; denominator : positive }.
Definition ratio (q : rational) : R := IZR (numerator q) / IZR (Zpos (denominator q)).

(** * The plant: xdot = f(x, u), one expression a state *)

Inductive expr :=
  | State (i : nat) | Input (j : nat) | Const (q : rational)
  | Add (a b : expr) | Neg (a : expr) | Mul (a b : expr) | Inv (a : expr) | Pow (a : expr) (k : nat)
  | Sin (a : expr) | Cos (a : expr) | Tanh (a : expr) | Exp (a : expr) | Atan (a : expr) | Sqrt (a : expr).

Fixpoint value (x u : list R) (e : expr) : R :=
  match e with
  | State i => nth i x 0
  | Input j => nth j u 0
  | Const q => ratio q
  | Add a b => value x u a + value x u b
  | Neg a => - value x u a
  | Mul a b => value x u a * value x u b
  | Inv a => / value x u a
  | Pow a k => value x u a ^ k
  | Sin a => sin (value x u a)
  | Cos a => cos (value x u a)
  | Tanh a => tanh (value x u a)
  | Exp a => exp (value x u a)
  | Atan a => atan (value x u a)
  | Sqrt a => sqrt (value x u a)
  end.

(** Nothing is divided by zero, and every root is one of a positive number: the expression is smooth around (x, u). *)
Fixpoint defined (x u : list R) (e : expr) : Prop :=
  match e with
  | State i => (i < length x)%nat
  | Input j => (j < length u)%nat
  | Const _ => True
  | Add a b | Mul a b => defined x u a /\ defined x u b
  | Inv a => defined x u a /\ value x u a <> 0
  | Sqrt a => defined x u a /\ 0 < value x u a
  | Neg a | Pow a _ | Sin a | Cos a | Tanh a | Exp a | Atan a => defined x u a
  end.

(** * The policy: layers with tanh between them *)

(** A row of weights with its bias; a layer is the list of its rows. *)
Definition layer : Type := list (list dyadic * dyadic).

Definition affine (l : layer) (x : list R) : list R :=
  map (fun row => dot (map real (fst row)) x + real (snd row)) l.

Fixpoint net (ls : list layer) (x : list R) : list R :=
  match ls with
  | [] => x
  | [l] => affine l x
  | l :: ls => net ls (map tanh (affine l x))
  end.

Inductive squashing := ByTanh | ByIdentity.
Inductive centring := AtOutput | AtPreactivation | NotCentred.

(** An input of the plant: u = scale * squash(.) + offset, its value at rest, and its bounds. *)
Record channel := Channel { scale : dyadic; offset : dyadic; rest : rational; least : rational; greatest : rational }.

Definition squash (s : squashing) (v : R) : R := match s with ByTanh => tanh v | ByIdentity => v end.

(** The inverse of tanh. *)
Definition artanh (y : R) : R := ln ((1 + y) / (1 - y)) / 2.

(** One input, of the network's output v at the state and w at the origin. *)
Definition act (s : squashing) (centred : centring) (c : channel) (v w : R) : R :=
  match centred with
  | AtOutput => real (scale c) * squash s v - real (scale c) * squash s w + ratio (rest c)
  | AtPreactivation =>
      real (scale c) * squash s (v - w + artanh ((ratio (rest c) - real (offset c)) / real (scale c))) + real (offset c)
  | NotCentred => real (scale c) * squash s v + real (offset c)
  end.

Fixpoint acts (s : squashing) (centred : centring) (cs : list channel) (v w : list R) : list R :=
  match cs, v, w with
  | c :: cs, p :: v, q :: w => act s centred c p q :: acts s centred cs v w
  | _, _, _ => []
  end.

(** * The certificate *)

Record certificate := Certificate {
  field : list expr;  (** f, one expression a state *)
  domain : list (rational * rational);  (** an interval a state *)
  channels : list channel;  (** one an input *)
  layers : list layer;
  squashed : squashing;
  centred : centring;
  P : list (list dyadic);
  level : dyadic  (** c2 *)
}.

Section Loop.
Variable c : certificate.

Definition states : nat := length (domain c).

Definition policy (x : list R) : list R :=
  acts (squashed c) (centred c) (channels c) (net (layers c) x) (net (layers c) (zeros states)).

(** The closed loop xdot = F(x). *)
Definition F (x : list R) : list R := map (value x (policy x)) (field c).

Definition matrix : list (list R) := map (map real) (P c).

(** V(x) = x'P x, and its derivative along the loop, 2 (P x)'F(x). *)
Definition V (x : list R) : R := form matrix x.
Definition Vdot (x : list R) : R := 2 * dot (apply matrix x) (F x).

(** The set of which all of this speaks. *)
Definition inside (x : list R) : Prop := length x = states /\ V x <= real (level c).

(** The dimensions fit: lists of another length would be read as if they were cut off, and nothing is. *)
Fixpoint chained (ls : list layer) (n : nat) : Prop :=
  match ls with
  | [] => n = length (channels c)
  | l :: ls => Forall (fun row => length (fst row) = n) l /\ chained ls (length l)
  end.

Definition shaped : Prop :=
  length (field c) = states /\ square states (P c) /\ layers c <> [] /\ chained (layers c) states.

(** A solution on [0, T): continuous at 0 from the right, and differentiable from then on. *)
Definition solution (x : R -> list R) (T : R) : Prop :=
  (forall t, 0 <= t < T -> length (x t) = states)
  /\ (forall i, (i < states)%nat -> forall eps, 0 < eps ->
      exists delta, 0 < delta /\ forall t, 0 < t < T -> t < delta -> Rabs (nth i (x t) 0 - nth i (x 0) 0) < eps)
  /\ (forall i, (i < states)%nat -> forall t, 0 < t < T ->
      derivable_pt_lim (fun s => nth i (x s) 0) t (nth i (F (x t)) 0)).

(** The claim, for a rate of decay. The numbers are those of the certificate's conditions. *)
Record claim (rate : R) : Prop := {
  dimensions : shaped;
  means_something : 0 < rate /\ 0 < real (level c);
  (* 0 *) smooth : forall x, inside x -> Forall (defined x (policy x)) (field c);
  (* 1 *) positive : symmetric matrix /\ forall x, length x = states -> x <> zeros states -> 0 < V x;
  (* 1' *) rests : policy (zeros states) = map (fun one => ratio (rest one)) (channels c) /\ F (zeros states) = zeros states;
  (* 2 *) in_domain : forall x, inside x ->
      Forall2 (fun one bounds => ratio (fst bounds) < one < ratio (snd bounds)) x (domain c);
  (* 3, 4 *) decreases : forall x, inside x -> x <> zeros states -> Vdot x < 0 /\ Vdot x + rate * V x < 0;
  (* 5 *) in_bounds : forall x, inside x ->
      Forall2 (fun one ch => ratio (least ch) <= one <= ratio (greatest ch)) (policy x) (channels c);
  (* what follows of trajectories: none leaves the set, and V decays along each *)
  trajectories : forall x T, 0 < T -> solution x T -> V (x 0) <= real (level c) -> forall t, 0 <= t < T ->
      inside (x t) /\ V (x t) <= V (x 0) * exp (- rate * t);
  (* the origin is stable, and after some time all that start in the set are near it *)
  stable : forall eps, 0 < eps -> exists delta, 0 < delta /\ forall x, (forall T, 0 < T -> solution x T) ->
      (forall i, (i < states)%nat -> Rabs (nth i (x 0) 0) < delta) ->
      forall t, 0 <= t -> forall i, (i < states)%nat -> Rabs (nth i (x t) 0) < eps;
  attractive : forall eps, 0 < eps -> exists time, 0 <= time /\ forall x, (forall T, 0 < T -> solution x T) ->
      V (x 0) <= real (level c) -> forall t, time <= t -> forall i, (i < states)%nat -> Rabs (nth i (x t) 0) < eps
}.
End Loop.
