"""Cart with an inverted pole (point mass), a force on the cart.

State x = (p, theta, p_dot, theta_dot): cart position in m, angle from upright in rad (unwrapped), their rates. Input u:
force on the cart in N. With s = sin(theta), c = cos(theta):
`p'' = (u + mp s (l theta'^2 - g c)) / (mc + mp s^2)`,
`theta'' = (-u c - mp l theta'^2 c s + (mc + mp) g s) / (l (mc + mp s^2))`.
Values: cart 1 kg, pole 0.1 kg, length 0.5 m, gravity 9.81 m/s^2, |u| <= 30 N, domain |p| <= 3 m,
|theta| <= 1.2 rad, rates within 8 m/s and 8 rad/s.

Source: equations of Tedrake, "Underactuated Robotics", section "Cart-Pole", with the angle from upright; masses, g and
30 N as in Li et al., "Two-Stage Learning of Stabilizing Neural Controllers", NeurIPS 2025, whose pole is 1 m long.
Length and domain are chosen here. `docs/plants.md` says what differs elsewhere.
"""

from __future__ import annotations

from certify.loop.expressions import Number, cos, sin, symbols
from certify.loop.plants.system import System, exact


def cartpole() -> System:
    """The cart with a pole: masses as in Li et al., a length chosen here."""
    p, theta, p_dot, theta_dot, u = symbols(["p", "theta", "p_dot", "theta_dot", "u"])
    mc, mp, length, g, force = symbols(["mc", "mp", "l", "g", "force"])
    s, c = sin(theta), cos(theta)
    mass = mc + mp * s**2
    pushed = u + force
    p_ddot = (pushed + mp * s * (length * theta_dot**2 - g * c)) / mass
    theta_ddot = (-pushed * c - mp * length * theta_dot**2 * c * s + (mc + mp) * g * s) / (length * mass)
    return System(
        name="cartpole",
        description="cart with an inverted pole, a force on the cart",
        states=(p, theta, p_dot, theta_dot),
        inputs=(u,),
        parameters={"mc": exact(1), "mp": exact("0.1"), "l": exact("0.5"), "g": exact("9.81")},
        dynamics=(p_dot, theta_dot, p_ddot, theta_ddot),
        u_eq=(Number(0),),
        domain=(
            (exact(-3), exact(3)),
            (exact("-1.2"), exact("1.2")),
            (exact(-8), exact(8)),
            (exact(-8), exact(8)),
        ),
        input_bounds=((exact(-30), exact(30)),),
        positive=frozenset({"mc", "mp", "l", "g"}),
        disturbances=(force,),
        units={
            "p": "m",
            "theta": "rad",
            "p_dot": "m/s",
            "theta_dot": "rad/s",
            "u": "N",
            "force": "N",
            "mc": "kg",
            "mp": "kg",
            "l": "m",
            "g": "m/s^2",
        },
    )
