"""Find states where a function being learned is wrong: it does not fall, or is low where nothing converges.

The search samples states and takes a few steps uphill or downhill. Each state found becomes a row of the next fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.lyapunov.function import LyapunovFunction
from certify.lyapunov.learning.flow import LearningFlow
from certify.lyapunov.learning.samples import Samples

Array = NDArray[np.float64]
_SAMPLES, _CLIMBERS, _SINKING, _ON_FACES = 30_000, 400, 4000, 2000
_AROUND = 3000
_CLIMB, _SINK, _STRIDE = 6, 12, 0.03  # steps, and their length in scaled states
_NEARBY, _BESIDE = 0.15, 0.05  # of the region's standard deviation: around its states, around violations


class Search:
    """A search of the domain outside of the inner ellipsoid, in z = x / scale.

    Parameters
    ----------
    flow, samples : the loop, and samples of its region of attraction.
    """

    def __init__(self, flow: LearningFlow, samples: Samples) -> None:
        self.flow, self.scale = flow, samples.scale
        self.region = samples.x[samples.attracted]
        self.spread = self.region.std(0)

    def rising(
        self,
        function: LyapunovFunction,
        below: float,
        above: float,
        known: Array,
        generator: np.random.Generator,
        least: float = -np.inf,
    ) -> tuple[Array, Array, Array]:
        """States z (B, n) with `least` <= N < `below` where N falls by less than -`above` per scaled length; the unit
        vector of the flow that is the worst of all corners, (B, n); and N's derivative along it, (B,).

        Parameters
        ----------
        known : violations found before, (K, n) in z: others are often near them.
        """
        flow, n = self.flow, self.flow.n
        around = self.region[generator.integers(len(self.region), size=_SAMPLES // 3)]
        x = [
            flow.uniform(_SAMPLES // 3, generator),
            around + _NEARBY * self.spread * generator.normal(size=(len(around), n)),
        ]
        if len(known):
            again = known[generator.integers(len(known), size=_SAMPLES // 3)] * self.scale
            x.append(again + _BESIDE * self.spread * generator.normal(size=again.shape))
        z = self._asked(np.concatenate(x) / self.scale)
        z = _between(function, z, least, below)
        v, slope = self.worst(function, z)
        z = np.concatenate([z, self._climbed(function, z[np.argsort(-slope, kind="stable")[:_CLIMBERS]])])
        z = _between(function, z, least, below)
        v, slope = self.worst(function, z)
        some = slope > above
        return z[some], v[some], slope[some]

    def near(self, function: LyapunovFunction, z: Array, generator: np.random.Generator) -> tuple[Array, Array]:
        """States (B, n) around one at which N does not fall, z (n,), at all distances up to a tenth of the region, at
        which N does not fall either; and the flow there as of `rising`."""
        apart = 10.0 ** generator.uniform(-4, -1, (_AROUND, 1)) * self.spread / self.scale
        around = self._asked(np.concatenate([z[None], z + apart * generator.normal(size=(_AROUND, len(z)))]))
        v, slope = self.worst(function, around)
        return around[slope >= 0], v[slope >= 0]

    def worst(self, function: LyapunovFunction, z: Array) -> tuple[Array, Array]:
        """The flow's direction at the corner where N falls least, (B, n), and N's derivative along it, (B,)."""
        directions = self.flow.directions(z * self.scale, self.scale)
        slopes = (function.gradient(z) * directions).sum(-1)
        corner = slopes.argmax(0)
        each = np.arange(len(z))
        return directions[corner, each], slopes[corner, each]

    def low(self, function: LyapunovFunction, below: float, generator: np.random.Generator) -> Array:
        """States z (B, n) on the domain's faces, or outside the region of attraction, with N < `below`."""
        flow, half = self.flow, (self.flow.high - self.flow.low) / 2 / self.scale
        z = np.concatenate([flow.faces(_ON_FACES, generator), flow.uniform(_SINKING, generator)]) / self.scale
        low, high = flow.low / self.scale, flow.high / self.scale
        fixed = np.zeros(z.shape, dtype=bool)
        fixed[np.arange(_ON_FACES), np.arange(_ON_FACES) % flow.n] = True
        length = generator.random((len(z), 1)) * 4 * _STRIDE
        found = [z]
        for _ in range(_SINK):
            way = np.where(fixed, 0.0, -function.gradient(z) * half)
            way /= np.linalg.norm(way, axis=-1, keepdims=True) + 1e-12
            z = np.clip(z + length * way * half, low, high)
            found.append(z)
        on_faces = np.concatenate([part[:_ON_FACES] for part in (found[0], found[-1])])
        within = np.concatenate([part[_ON_FACES:] for part in (found[0], found[2], found[4])])
        within = within[function(within) < below]
        within = within[~self.flow.run(within * self.scale, self.scale).converged]
        return np.concatenate([on_faces[function(on_faces) < below], within])

    def _asked(self, z: Array) -> Array:
        x = z * self.scale
        return np.asarray(z[self.flow.inside(x) & ~self.flow.is_home(x)])

    def _climbed(self, function: LyapunovFunction, z: Array) -> Array:
        """States driven to where N falls less, by differences along each axis."""
        if not len(z):
            return z
        steps = np.concatenate([np.zeros((1, self.flow.n)), 1e-4 * np.eye(self.flow.n)])
        for _ in range(_CLIMB):
            points = (z[None] + steps[:, None]).reshape(-1, self.flow.n)
            slopes = self.worst(function, points)[1].reshape(len(steps), -1)
            way = ((slopes[1:] - slopes[0]) / 1e-4).T
            z = z + _STRIDE * way / (np.linalg.norm(way, axis=-1, keepdims=True) + 1e-12)
        return self._asked(z)


def _between(function: LyapunovFunction, z: Array, least: float, below: float) -> Array:
    value = function(z)
    return np.asarray(z[(value < below) & (value >= least)])
