(** What is computed: whether the evidence shows the claim.

    `Soundness.v` proves that a `true` is right. *)
From Coq Require Import Reals List ZArith QArith Bool.
From Coq Require Floats.
Require Import Vectors Spec Data Enclosure Forms Slopes Loop.
Import ListNotations.
Close Scope Q_scope.

(** * Exact numbers *)

Definition dyadicQ (d : dyadic) : Q :=
  match exponent d with
  | Zneg e => Qmake (mantissa d) (2 ^ e)
  | e => inject_Z (mantissa d * 2 ^ e)
  end.

Definition ratioQ (q : rational) : Q := Qmake (numerator q) (denominator q).

Fixpoint powerQ (q : Q) (k : nat) : Q := match k with O => 1%Q | S k => (q * powerQ q k)%Q end.

(** The value of an expression at the origin with inputs u, where it is rational by its form. *)
Fixpoint exactQ (u : list Q) (e : expr) : option Q :=
  match e with
  | State _ => Some 0%Q
  | Input j => Some (nth j u 0%Q)
  | Const q => Some (ratioQ q)
  | Add a b => bind (exactQ u a) (fun p => bind (exactQ u b) (fun q => Some (Qred (p + q)%Q)))
  | Mul a b => bind (exactQ u a) (fun p => bind (exactQ u b) (fun q => Some (Qred (p * q)%Q)))
  | Neg a => bind (exactQ u a) (fun p => Some (- p)%Q)
  | Inv a => bind (exactQ u a) (fun p => if Qeq_bool p 0 then None else Some (Qred (/ p)%Q))
  | Pow a k => bind (exactQ u a) (fun p => Some (Qred (powerQ p k)))
  | Sin a | Tanh a | Atan a => bind (exactQ u a) (fun p => if Qeq_bool p 0 then Some 0%Q else None)
  | Cos a | Exp a => bind (exactQ u a) (fun p => if Qeq_bool p 0 then Some 1%Q else None)
  | Sqrt a => bind (exactQ u a) (fun p =>
      let r := Qmake (Z.sqrt (Qnum p)) (Z.to_pos (Z.sqrt (Zpos (Qden p)))) in
      if Qeq_bool (r * r) p && Qle_bool 0 r then Some r else None)
  end.

Definition is_zero (o : option Q) : bool := match o with Some q => Qeq_bool q 0 | None => false end.

(** The numbers are those of the k-th row of the identity, from its j-th entry on. *)
Fixpoint is_unit (k j : nat) (l : list Q) : bool :=
  match l with
  | [] => true
  | q :: l => Qeq_bool q (if Nat.eqb k j then 1 else 0) && is_unit k (S j) l
  end.

(** T W = I *)
Definition inverse (n : nat) (T W : list (list rational)) : bool :=
  let T := map (map ratioQ) T in
  let W := map (map ratioQ) W in
  Nat.eqb (length T) n &&
  forallb (fun k => let row := combine_rows Qplus Qmult (nth k T []) W in Nat.eqb (length row) n && is_unit k 0 row) (seq 0 n).

(** * Shapes *)

Definition squareb (n : nat) {A} (M : list (list A)) : bool :=
  Nat.eqb (length M) n && forallb (fun row => Nat.eqb (length row) n) M.

Fixpoint chainedb (m : nat) (ls : list layer) (n : nat) : bool :=
  match ls with
  | [] => Nat.eqb n m
  | l :: ls => forallb (fun row => Nat.eqb (length (fst row)) n) l && chainedb m ls (length l)
  end.

Definition zeroD : dyadic := Dyadic 0 0.
Definition same (a b : dyadic) : bool := Z.eqb (mantissa a) (mantissa b) && Z.eqb (exponent a) (exponent b).

Definition symmetricb (n : nat) (M : list (list dyadic)) : bool :=
  forallb (fun i => forallb (fun j => same (nth j (nth i M []) zeroD) (nth i (nth j M []) zeroD)) (seq 0 n)) (seq 0 n).

(** * Boxes *)

Definition box_of (Z C : list I.type) : box :=
  let all := zip I.join Z C in
  Box all C (zip (fun z c => I.join (sub z c) (whole 0)) all C).

Definition halfway (lo hi : PrimFloat.float) : I.type := point (PrimFloat.div (PrimFloat.add lo hi) PrimFloat.two).

Fixpoint set {A} (k : nat) (a : A) (l : list A) : list A :=
  match l, k with
  | [], _ => []
  | _ :: l, O => a :: l
  | b :: l, S k => b :: set k a l
  end.

Fixpoint within (Z Y : list I.type) : bool :=
  match Z, Y with
  | [], [] => true
  | z :: Z, y :: Y => I.subset z y && within Z Y
  | _, _ => false
  end.

Section Check.

Variables (c : certificate) (rate : rational) (e : evidence).

Let n := states c.

(** Of a policy that tanh keeps within its bounds: decided in exact numbers, for at the bounds nothing is to spare. *)
Definition roomy (ch : channel) : bool :=
  match squashed c, centred c with
  | ByTanh, AtPreactivation | ByTanh, NotCentred =>
      let s := Qabs.Qabs (dyadicQ (scale ch)) in
      let o := dyadicQ (offset ch) in
      Qle_bool (ratioQ (least ch)) (o - s) && Qle_bool (o + s) (ratioQ (greatest ch))
  | _, _ => false
  end.

Fixpoint bounded (cs : list channel) (u : list quantity) : bool :=
  match cs, u with
  | [], [] => true
  | ch :: cs, q :: u =>
      (roomy ch || (atleast0 (sub (range q) (ratioI (least ch))) && atleast0 (sub (ratioI (greatest ch)) (range q))))
      && bounded cs u
  | _, _ => false
  end.

(** The input at rest is u_eq by its form: where nothing is centred, because the offset is and no bias adds to it. *)
Definition rests_here (ch : channel) : bool :=
  match centred c with
  | NotCentred => Qeq_bool (dyadicQ (offset ch)) (ratioQ (rest ch))
  | _ => true
  end.
Definition unbiased : bool :=
  match centred c with
  | NotCentred => forallb (forallb (fun row => Z.eqb (mantissa (snd row)) 0)) (layers c)
  | _ => true
  end.

Definition well_formed : bool :=
  Nat.eqb (length (field c)) n && squareb n (P c) && negb (match layers c with [] => true | _ => false end)
  && chainedb (length (channels c)) (layers c) n && symmetricb n (P c)
  && Z.ltb 0 (numerator rate)
  && forallb (channel_fits (squashed c) (centred c)) (channels c)
  && forallb rests_here (channels c) && unbiased
  && forallb (fun f => is_zero (exactQ (map (fun ch => ratioQ (rest ch)) (channels c)) f)) (field c)
  && squareb n (T e) && squareb n (W e) && inverse n (T e) (W e)
  && Nat.eqb (length (root e)) n && Nat.eqb (length (core e)) n.

(** What is computed once. *)
Record ready := Ready {
  coordinates : list (list I.type);  (** T *)
  gradient : list (list I.type);  (** P T *)
  shape : list (list I.type);  (** T'P T *)
  network : list layerI;
  outputs_at_0 : list I.type;
  drives : list channelI;
  levelI : I.type;
  rateI : I.type;
  heart : list I.type  (** the core *)
}.

Definition prepare : ready :=
  let t := map (map ratioI) (T e) in
  let y := productI (map (map dyadicI) (P c)) t in
  let ls := layersI (layers c) in
  Ready t y (productI (transpose (whole 0) n t) y) ls
    (map range (netQ [] ls (repeat (constant (whole 0)) n)))
    (map prepared (channels c)) (dyadicI (level c)) (ratioI rate)
    (map (fun r => segment (F.neg r) r) (core e)).

Section With.
Variable p : ready.

(** level (a.z)^2 < r^2 z'S z for all z other than 0: where V is at most the level, |a.z| < |r|. *)
Definition keeps (a : list I.type) (r : I.type) : bool :=
  Nat.eqb (length a) n &&
  definite n (lessI (levelI p) (map (map (mul (I.sqr prec r))) (shape p)) a a).

Definition unitI (k : nat) : list I.type := map (fun j => whole (if Nat.eqb k j then 1 else 0)) (seq 0 n).

Definition set_fits : bool :=
  positiveI (levelI p) && squareb n (gradient p) && squareb n (shape p) && definite n (shape p)
  && forallb (fun k => let r := nth k (root e) PrimFloat.zero in atleast0 (point r) && keeps (unitI k) (point r)) (seq 0 n)
  && forallb (fun one => let '(a, (lo, hi)) := one in
       positiveI (I.neg (ratioI lo)) && positiveI (ratioI hi) && keeps a (ratioI lo) && keeps a (ratioI hi))
     (combine (coordinates p) (domain c)).

Definition policyQ (b : box) : list quantity :=
  actsQ (apart b) (squashed c) (centred c) (drives p)
    (netQ (apart b) (network p) (linearsQ b (coordinates p))) (outputs_at_0 p).

Definition fieldQ (b : box) (u : list quantity) : option (list quantity) :=
  valuesQ (apart b) (linearsQ b (coordinates p)) u (field c).

(** Vdot + rate V + k (level - V) *)
Definition decayQ (b : box) (k : I.type) (f : list quantity) : quantity :=
  let v := formQ b (shape p) in
  tighten (apart b)
    (plusQ (plusQ (scaleQ (whole 2) (dotQ (apart b) (linearsQ b (gradient p)) f)) (scaleQ (rateI p) v))
      (scaleQ k (plusQ (constant (levelI p)) (negQ v)))).

Definition outside (b : box) : bool := positiveI (sub (formI 0 (at_all b) (shape p) (at_all b)) (levelI p)).

Definition falls (b : box) (k : PrimFloat.float) : bool :=
  let u := policyQ b in
  bounded (channels c) u && atleast0 (point k) &&
  match fieldQ b u with
  | Some f => positiveI (I.neg (range (decayQ b (point k) f)))
  | None => false
  end.

Definition leaf (b : box) (k : PrimFloat.float) : bool :=
  if outside b then true else if within (at_all b) (heart p) then true else falls b k.

(** On the core F_i is a sum of slopes times z, so that Vdot + rate V = z'M z. *)
Definition core_holds : bool :=
  let b := box_of (heart p) (map (fun _ => whole 0) (heart p)) in
  let u := policyQ b in
  bounded (channels c) u &&
  match fieldQ b u with
  | Some f =>
      let G := map (fun q => plus add (slopes q) (repeat (whole 0) n)) f in
      let A := productI (transpose (whole 0) n (gradient p)) G in
      let M := zip (fun a s => map I.neg (plus add (map (mul (whole 2)) a) (map (mul (rateI p)) s))) A (shape p) in
      Nat.eqb (length A) (length (shape p)) && squareb n M && definite n M
  | None => false
  end.

Fixpoint tree_holds (t : tree) (lo hi : list PrimFloat.float) : bool :=
  match t with
  | Leaf k => leaf (box_of (zip segment lo hi) (zip halfway lo hi)) k
  | Split j m below above => tree_holds below lo (set j m hi) && tree_holds above (set j m lo) hi
  end.

End With.

Definition check : bool :=
  well_formed &&
  (let p := prepare in set_fits p && core_holds p && tree_holds p (splits e) (map F.neg (root e)) (root e)).

End Check.
