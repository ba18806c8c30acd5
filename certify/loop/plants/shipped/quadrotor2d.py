"""Planar quadrotor with two thrusts.

State x = (x, y, theta, x_dot, y_dot, theta_dot): position in m, roll angle in rad (unwrapped), their rates. Inputs
u1, u2: absolute thrusts in N; hover is u1 = u2 = m g / 2.
`x'' = -sin(theta) (u1 + u2) / m`, `y'' = cos(theta) (u1 + u2) / m - g`, `theta'' = (l / I) (u1 - u2)`.
Values: mass 0.486 kg, arm 0.25 m, inertia 0.00383 kg m^2, gravity 9.81 m/s^2, 0 <= u_i <= 6 N, domain
|x|, |y| <= 3 m, |theta| <= 1.2 rad, rates within 8.

Source: equations, m, l, I and g are those of `underactuated/quadrotor2d.py` (repository RussTedrake/underactuated),
"based on" Bouadi, Bouchoucha and Tadjine, 2007; Dai et al., "Lyapunov-stable neural-network control", RSS 2021, have
the same. 6 N is in Li et al., NeurIPS 2025. The domain is chosen here. `docs/plants.md` says what differs elsewhere.
"""

from __future__ import annotations

from certify.loop.expressions import cos, sin, symbols
from certify.loop.plants.system import System, exact


def quadrotor2d() -> System:
    """The planar quadrotor with the parameters of Bouadi, Bouchoucha and Tadjine, as Tedrake rounds them."""
    states = symbols(["x", "y", "theta", "x_dot", "y_dot", "theta_dot"])
    _, _, theta, x_dot, y_dot, theta_dot = states
    u1, u2, m, length, inertia, g = symbols(["u1", "u2", "m", "l", "I", "g"])
    wind_x, wind_y, torque = symbols(["wind_x", "wind_y", "torque"])
    thrust = (u1 + u2) / m
    three, bound, rate = (exact(-3), exact(3)), (exact("-1.2"), exact("1.2")), (exact(-8), exact(8))
    return System(
        name="quadrotor2d",
        description="planar quadrotor with two thrusts",
        states=states,
        inputs=(u1, u2),
        parameters={"m": exact("0.486"), "l": exact("0.25"), "I": exact("0.00383"), "g": exact("9.81")},
        dynamics=(
            x_dot,
            y_dot,
            theta_dot,
            -sin(theta) * thrust + wind_x / m,
            cos(theta) * thrust - g + wind_y / m,
            length / inertia * (u1 - u2) + torque / inertia,
        ),
        u_eq=(m * g / 2, m * g / 2),
        domain=(three, three, bound, rate, rate, rate),
        input_bounds=((exact(0), exact(6)), (exact(0), exact(6))),
        positive=frozenset({"m", "l", "I", "g"}),
        disturbances=(wind_x, wind_y, torque),
        units={
            "x": "m",
            "y": "m",
            "theta": "rad",
            "x_dot": "m/s",
            "y_dot": "m/s",
            "theta_dot": "rad/s",
            "u1": "N",
            "u2": "N",
            "wind_x": "N",
            "wind_y": "N",
            "torque": "N m",
            "m": "kg",
            "l": "m",
            "I": "kg m^2",
            "g": "m/s^2",
        },
    )
