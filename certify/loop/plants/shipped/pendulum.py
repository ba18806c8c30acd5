"""Inverted pendulum with a torque at the pivot (the paper's first example).

State x = (theta, theta_dot): angle from upright in rad (unwrapped), angular rate in rad/s. Input u:
torque in N m. `theta'' = (g/l) sin(theta) - b/(m l^2) theta' + (u + torque)/(m l^2)`; upright is the origin, and the
disturbance `torque` acts at the joint.
Values: mass 0.15 kg, length 0.5 m, friction 0.1 N m s, gravity 9.81 m/s^2, |u| <= 6 N m,
domain |theta| <= 3.14 rad, |theta_dot| <= 20 rad/s.

Source: equation, m, l, b and g are those of Chang, Roohi and Gao, "Neural Lyapunov Control", NeurIPS 2019 (repository
YaChienChang/Neural-Lyapunov-Control, `Inverted _Pendulum.ipynb`); Zhou, Quartz, De Sterck and Liu, NeurIPS 2022, have
the same. 6 N m is in Yang et al., ICML 2024. The domain is chosen here. `docs/plants.md` says what differs elsewhere.
"""

from __future__ import annotations

from certify.loop.expressions import Number, sin, symbols
from certify.loop.plants.system import System, exact


def pendulum() -> System:
    """The inverted pendulum with the parameters of Chang, Roohi and Gao."""
    theta, theta_dot, u, m, length, b, g = symbols(["theta", "theta_dot", "u", "m", "l", "b", "g"])
    (torque,) = symbols(["torque"])
    inertia = m * length**2
    acceleration = g / length * sin(theta) - b / inertia * theta_dot + u / inertia + torque / inertia
    return System(
        name="pendulum",
        description="inverted pendulum with a torque at the pivot",
        states=(theta, theta_dot),
        inputs=(u,),
        parameters={"m": exact("0.15"), "l": exact("0.5"), "b": exact("0.1"), "g": exact("9.81")},
        dynamics=(theta_dot, acceleration),
        u_eq=(Number(0),),
        domain=((exact("-3.14"), exact("3.14")), (exact(-20), exact(20))),
        input_bounds=((exact(-6), exact(6)),),
        positive=frozenset({"m", "l", "g"}),
        disturbances=(torque,),
        units={
            "theta": "rad",
            "theta_dot": "rad/s",
            "u": "N m",
            "torque": "N m",
            "m": "kg",
            "l": "m",
            "b": "N m s",
            "g": "m/s^2",
        },
    )
