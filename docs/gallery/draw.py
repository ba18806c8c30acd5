"""Prove the gallery's plants, draw their certificates, and write its table: `make gallery`, a quarter of an hour.

The pictures and `proved.txt` are kept in the repository, so that building the site stays quick; what they show is read
from certificates that the checker has accepted in this run. A certificate that `out/gallery` already has is checked
again and not searched for again.
"""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from certify.certificates import Certificate, read_certificate, run_checker
from certify.certificates.claims import Enlarged, Practical
from certify.certificates.drawn import nonlinearity_of
from certify.lyapunov import semi_axes, volume
from certify.report.figures import draw
from certify.report.words import above, below, nonlinearity_in_words, pretty_unit, symbol

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).parent
LARGEST = 80_000  # bytes of a picture


@dataclass(frozen=True)
class Entry:
    """A row: what it shows, and the options of `certify roa`; `plant` is a file of examples/plants."""

    name: str
    shows: str
    policy: str
    plant: str | None = None
    options: tuple[str, ...] = ()

    @property
    def command(self) -> list[str]:
        system = ["--system", f"examples/plants/{self.plant}.toml"] if self.plant else []
        return ["certify", "roa", "--policy", f"examples/policies/{self.policy}.pt", *system, *self.options]


OPTIMISED = ("--candidate", "optimised", "--effort", "1.2")
WHERE = "x=0.5,y=0.5,z=0.5,phi=0.3,theta=0.3,psi=0.3,vx=0.5,vy=0.5,vz=0.5,p=0.5,q=0.5,r=0.5"
QUADROTOR = ("--effort", "12", "--box", WHERE)
ENTRIES = (
    Entry("pendulum", "inverted pendulum, up to its domain", "pendulum"),
    Entry(
        "practical",
        "the same plant under plain SAC, seen from where it rests, beside the origin: practical stability",
        "without_gain/pendulum",
        options=("--claim", "practical", "--candidate", "lqr"),
    ),
    Entry(
        "van_der_pol", "oscillator in reversed time, inside its limit cycle", "van_der_pol", "van_der_pol", OPTIMISED
    ),
    Entry("two_machines", "swing equation of a power system", "two_machines", "two_machines", OPTIMISED),
    Entry("two_tanks", "Torricelli's law, an operating point", "two_tanks", "two_tanks", OPTIMISED),
    Entry("maglev", "a ball below a magnet", "maglev", "maglev", OPTIMISED),
    Entry("bicycle", "path following, three states", "bicycle", "bicycle", OPTIMISED),
    Entry("furuta", "rotary pendulum, four states", "furuta", "furuta", OPTIMISED),
    Entry("cartpole", "four states, 256 units a layer", "cartpole", options=("--candidate", "optimised")),
    Entry("satellite", "attitude, six states and three inputs", "satellite", "satellite", OPTIMISED),
    Entry("quadrotor2d", "six states, four layers of 256 units", "quadrotor2d"),
    Entry("quadrotor3d", "twelve states on their true equations", "quadrotor3d", options=QUADROTOR),
)


def proved(entry: Entry) -> Certificate:
    """The entry's certificate, accepted by the checker."""
    folder = ROOT / "out" / "gallery" / entry.name
    path = folder / "certificate.json"
    if not path.exists():
        command = [str(Path(sys.executable).parent / "certify"), *entry.command[1:], "--out", str(folder), "--quiet"]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    answer = run_checker(path)
    if answer["result"] != "ACCEPTED":
        raise SystemExit(f"{path} must be accepted; the checker said {answer}. Remove the file and run this again.")
    return read_certificate(path)


def light(svg: str) -> str:
    """The drawing with its paths in tenths of a point, which no eye sees."""
    rounded = re.compile(r"-?\d+\.\d+")
    return re.sub(r' d="[^"]*"', lambda path: rounded.sub(lambda v: f"{float(v[0]):.1f}", path[0]), svg)


def picture(entry: Entry, certificate: Certificate) -> None:
    """The first figure of the report, as a file."""
    pictures, _ = draw(certificate, accepted=True)
    svg = light(pictures[0].svg)
    if len(svg.encode("utf-8")) > LARGEST:
        raise SystemExit(f"the picture of {entry.name} must be below {LARGEST} bytes; it has {len(svg)}. Draw less.")
    (PAGE / f"{entry.name}.svg").write_text(svg, "utf-8")


def section(entry: Entry, certificate: Certificate) -> str:
    """What the page says of an entry; numbers are rounded down."""
    system, network = certificate.system, certificate.network
    claim = certificate.claim
    shape = (claim.start.P, 1.0) if isinstance(claim, Enlarged) else (certificate.P, certificate.roa)
    reach = zip(system.states, semi_axes(*shape).tolist(), strict=True)
    units = {name: "" if unit == "1" else pretty_unit(unit) for name, unit in system.units.items()}
    axes = ", ".join(f"{symbol(s.name)} {below(v, 3)} {units.get(s.name, '')}".strip() for s, v in reach)
    size = below(volume(*shape), 3)
    whose = " of the tube's start" if isinstance(claim, Enlarged) else ""
    kind = "area" if system.n == 2 else "volume"
    inner = f"c₁ = {below(certificate.inner, 4)}"
    if isinstance(claim, Practical):
        inner = f"c₀ = {above(claim.floor, 4)}"
    return "\n".join(
        [
            f"## {entry.name}",
            "",
            f"{entry.shows[0].upper()}{entry.shows[1:]}. Policy {'-'.join(map(str, network.layers))}.",
            "",
            f"![The proved set of {entry.name}, section through the origin]({entry.name}.svg)",
            "",
            f"On the axes ± {axes}; {kind} {size}{whose}; {inner}, c₂ = {below(certificate.roa)}.",
            "",
            f"Linear part *: {beside_a_gain(certificate)}.",
            "",
            "<!-- shown: by make gallery -->",
            "```sh",
            " ".join(entry.command),
            "```",
        ]
    )


def beside_a_gain(certificate: Certificate) -> str:
    """Whether the policy does more on the set than a gain, sampled."""
    found = nonlinearity_of(certificate)
    return "not compared" if found is None else nonlinearity_in_words(found.to_dict())


def main() -> None:
    """All entries, in order."""
    sections = []
    for entry in ENTRIES:
        certificate = proved(entry)
        picture(entry, certificate)
        sections.append(section(entry, certificate))
        print(entry.name, (PAGE / f"{entry.name}.svg").stat().st_size)
    (PAGE / "proved.txt").write_text("\n\n".join(sections) + "\n", "utf-8")


if __name__ == "__main__":
    main()
