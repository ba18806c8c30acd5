"""Quadrotor with four thrusts.

State x = (x, y, z, phi, theta, psi, vx, vy, vz, p, q, r): position in m; roll, pitch and yaw in rad (ZYX, unwrapped);
velocity in m/s; body rates in rad/s. Inputs u1 .. u4: absolute thrusts in N along the body's z; hover is u_i = m g / 4.
With F = u1 + u2 + u3 + u4 and the body's z axis in the world, R e3:
`v' = R e3 F / m - g e3`,
`R e3 = (cos phi sin theta cos psi + sin phi sin psi, cos phi sin theta sin psi - sin phi cos psi, cos phi cos theta)`;
`phi' = p + tan(theta) (sin phi q + cos phi r)`, `theta' = cos phi q - sin phi r`,
`psi' = (sin phi q + cos phi r) / cos theta`;
`I w' = tau - w x I w`, `tau = (a (u2 - u4), a (u3 - u1), k (u1 - u2 + u3 - u4))`.
Values: mass 0.486 kg, arm a 0.225 m, torque per thrust k 1.1/29 m, inertia (4.9e-3, 4.9e-3, 8.8e-3) kg m^2, gravity
9.81 m/s^2, 0 <= u_i <= 3.6 N; domain: position within 3, phi and theta within 1, psi within 3, velocity within 6, body
rates within 12.

Source: equations and all numbers but the mass are those of Dai et al., RSS 2021 (repository
StanfordASL/neural-network-lyapunov, `examples/quadrotor3d/quadrotor.py`), after Tayebi and McGilvray, 2006. There the
mass is 0.468 kg; 0.486 kg and 3.6 N are in Li et al., NeurIPS 2025. The domain is chosen here. `docs/plants.md` says
what differs elsewhere.
"""

from __future__ import annotations

from fractions import Fraction

from certify.loop.expressions import cos, sin, symbols, tan
from certify.loop.plants.system import System, exact


def quadrotor3d() -> System:
    """The quadrotor with the parameters of Tayebi and McGilvray, but the mass of Li et al."""
    states = symbols(["x", "y", "z", "phi", "theta", "psi", "vx", "vy", "vz", "p", "q", "r"])
    _, _, _, phi, theta, psi, vx, vy, vz, p, q, r = states
    inputs = symbols(["u1", "u2", "u3", "u4"])
    u1, u2, u3, u4 = inputs
    m, a, k, Ix, Iy, Iz, g = symbols(["m", "a", "k", "Ix", "Iy", "Iz", "g"])
    wind_x, wind_y, wind_z, torque_x, torque_y, torque_z = disturbances = symbols(
        ["wind_x", "wind_y", "wind_z", "torque_x", "torque_y", "torque_z"]
    )
    lift = (u1 + u2 + u3 + u4) / m
    turn = sin(phi) * q + cos(phi) * r
    values = {"m": "0.486", "a": "0.225", "k": "11/290", "Ix": "4.9e-3", "Iy": "4.9e-3", "Iz": "8.8e-3", "g": "9.81"}
    names = {
        **dict.fromkeys(("x", "y", "z", "a", "k"), "m"),
        **dict.fromkeys(("phi", "theta", "psi"), "rad"),
        **dict.fromkeys(("vx", "vy", "vz"), "m/s"),
        **dict.fromkeys(("p", "q", "r"), "rad/s"),
        **dict.fromkeys(("u1", "u2", "u3", "u4", "wind_x", "wind_y", "wind_z"), "N"),
        **dict.fromkeys(("torque_x", "torque_y", "torque_z"), "N m"),
        **dict.fromkeys(("Ix", "Iy", "Iz"), "kg m^2"),
        "m": "kg",
        "g": "m/s^2",
    }

    def within(half: str) -> tuple[Fraction, Fraction]:
        return exact("-" + half), exact(half)

    return System(
        name="quadrotor3d",
        description="quadrotor with four thrusts",
        states=states,
        inputs=inputs,
        parameters={name: exact(value) for name, value in values.items()},
        dynamics=(
            vx,
            vy,
            vz,
            p + tan(theta) * turn,
            cos(phi) * q - sin(phi) * r,
            turn / cos(theta),
            (cos(phi) * sin(theta) * cos(psi) + sin(phi) * sin(psi)) * lift + wind_x / m,
            (cos(phi) * sin(theta) * sin(psi) - sin(phi) * cos(psi)) * lift + wind_y / m,
            cos(phi) * cos(theta) * lift - g + wind_z / m,
            (a * (u2 - u4) + (Iy - Iz) * q * r) / Ix + torque_x / Ix,
            (a * (u3 - u1) + (Iz - Ix) * p * r) / Iy + torque_y / Iy,
            (k * (u1 - u2 + u3 - u4) + (Ix - Iy) * p * q) / Iz + torque_z / Iz,
        ),
        u_eq=(m * g / 4,) * 4,
        domain=(within("3"),) * 3 + (within("1"),) * 2 + (within("3"),) + (within("6"),) * 3 + (within("12"),) * 3,
        input_bounds=((exact(0), exact("3.6")),) * 4,
        positive=frozenset(values),
        disturbances=disturbances,
        units=names,
    )
