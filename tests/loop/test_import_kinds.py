"""Policies as people write them: normalisers and dropout in evaluation, two heads, normalisations, files of numbers."""

from __future__ import annotations

import pickle
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.inputs import lines
from certify.errors import InputError
from certify.loop.networks import Clip, Map
from certify.loop.plants import get_system
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.loop.policies.importers.constants import computed
from certify.loop.policies.importers.memory import import_module

torch = pytest.importorskip("torch")
nn: Any = torch.nn
PLANT = get_system("pendulum")
SAID = ImportOptions(states=("theta", "theta_dot"), normaliser="none", action_scale=(Fraction(1),))
LAYERS = replace(SAID, squash="identity", activation="relu")
STATES = np.random.default_rng(0).uniform([-3, -20], [3, 20], (200, 2))


class Policy(nn.Module):  # type: ignore[misc]
    """A network in a form that its name says."""

    def __init__(self, kind: str, *between: Any, outputs: int = 1) -> None:
        super().__init__()
        torch.manual_seed(4)
        self.kind = kind
        self.first, self.between, self.last = nn.Linear(2, 6), nn.Sequential(*between), nn.Linear(6, outputs)
        self.register_buffer("mean", torch.tensor([0.3, -0.2]))
        self.register_buffer("var", torch.tensor([2.0, 30.0]))
        self.register_buffer("most", torch.tensor([0.3]))

    def forward(self, x: Any) -> Any:
        y = self.last(self.between(self.first(self.observed(x))))
        if self.kind in ("chunk", "split"):
            return torch.tanh(y.chunk(2, -1)[1] if self.kind == "chunk" else y.split([3, 1], 1)[1])
        if self.kind == "slice":
            return y[:, 2:-1]
        if self.kind == "two heads":
            return y.clamp(-5, 2), torch.tanh(y) * 6
        return torch.maximum(torch.minimum(y, self.most), -self.most) if self.kind == "bounds" else y

    def observed(self, x: Any) -> Any:
        match self.kind:
            case "normalised":
                return ((x - self.mean) / torch.sqrt(self.var + 1e-8)).clip(-10.0, 10.0)
            case "rsqrt":
                return (x - self.mean) * (self.var + 1e-8).rsqrt()
            case "deviation":
                return (x - self.mean) / (self.var**0.5 + 1e-2)
            case "rows":
                return torch.flatten(x.float().view(x.shape[0], -1), 1)
        return x


class RootMean(nn.Module):  # type: ignore[misc]
    def __init__(self, epsilon: float = 1e-6) -> None:
        super().__init__()
        self.gain, self.epsilon = nn.Parameter(torch.linspace(0.5, 2.0, 6)), epsilon

    def forward(self, x: Any) -> Any:
        return self.gain * x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + self.epsilon)


def batch_norm() -> Any:
    norm = nn.BatchNorm1d(6)
    norm(torch.randn(64, 6, generator=torch.Generator().manual_seed(1)) * 3 + 1)  # moves its statistics
    return norm


KINDS: dict[str, Any] = {
    **{kind: lambda kind=kind: Policy(kind, nn.ReLU()) for kind in ("normalised", "rsqrt", "deviation", "bounds")},
    **{k: lambda k=k: Policy(k, nn.SiLU(), outputs=4) for k in ("split", "slice")},
    "chunk": lambda: Policy("chunk", nn.SiLU(), outputs=2),
    "dropout": lambda: Policy("", nn.Dropout(0.3), nn.ReLU(), nn.Identity()),
    "batch norm": lambda: Policy("", batch_norm(), nn.Tanh()),
    "rms norm": lambda: Policy("", nn.RMSNorm(6), nn.GELU()),
    "rms norm of its own": lambda: Policy("", RootMean(), nn.ELU()),
    "prelu": lambda: Policy("", nn.PReLU(6, 0.1)),
    "softplus": lambda: Policy("", nn.Softplus(3.0)),
}
ROWS = {"rows": lambda: Policy("rows", nn.Softsign())}


def saved(module: Any, form: str, path: Path) -> Path:
    x = torch.zeros(1, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if form == "onnx":
            torch.onnx.export(
                module, (x,), path, dynamo=False, opset_version=18, dynamic_axes={"x": {0: "b"}}, input_names=["x"]
            )
            return path
        torch.jit.save(
            torch.jit.trace(module, x, check_trace=False) if form == "trace" else torch.jit.script(module), path
        )
    return path


def agree(policy: Any, module: Any, pick: Any = lambda y: y) -> None:
    """In double precision the policy is the module, up to 1e-12."""
    with torch.no_grad():
        wanted = pick(module.double()(torch.tensor(STATES))).numpy()
    inside = np.ones(len(STATES), dtype=bool)
    if policy.valid is not None:
        inside = np.all((policy.valid[:, 0] <= STATES) & (policy.valid[:, 1] >= STATES), axis=1)
    assert inside.sum() > 20
    assert np.allclose(np.asarray(policy.network(STATES, PLANT.exact_u_eq()))[inside], wanted[inside], atol=1e-12)


@pytest.mark.parametrize("form", ["memory", "trace", "onnx"])
@pytest.mark.parametrize("kind", KINDS)
def test_kinds(kind: str, form: str, tmp_path: Path) -> None:
    module = KINDS[kind]().eval()
    if form == "onnx" and kind in ("rms norm", "dropout"):
        pytest.skip("torch does not write it, or removes it")
    path = tmp_path / ("p.onnx" if form == "onnx" else "p.pt")
    found = (
        import_module(module, PLANT, SAID)
        if form == "memory"
        else import_policy(saved(module, form, path), PLANT, SAID)
    )
    if kind == "rms norm":
        module.between[0].eps = float(torch.finfo(torch.float32).eps)
    loose = form == "onnx" and kind in ("normalised", "rsqrt", "deviation", "rms norm of its own", "batch norm")
    if loose:  # an exporter has added epsilon in single precision
        assert found.difference.in_double < 1e-10
    else:
        agree(found.policy, module)


@pytest.mark.parametrize("kind", ["dropout", "batch norm", "rms norm", "prelu"])
def test_scripted_kinds(kind: str, tmp_path: Path) -> None:
    """A Sequential can be scripted; its modules have branches on constants, words, and methods of their own."""
    layers = KINDS[kind]()
    module = nn.Sequential(layers.first, *layers.between, layers.last).eval()
    found = import_policy(saved(module, "script", tmp_path / "p.pt"), PLANT, SAID)
    if kind == "rms norm":
        module[1].eps = float(torch.finfo(torch.float32).eps)
    agree(found.policy, module)


def test_rows_and_conversions(tmp_path: Path) -> None:
    module = ROWS["rows"]().eval()
    found = import_module(module, PLANT, SAID)
    traced = import_policy(saved(module, "trace", tmp_path / "p.pt"), PLANT, SAID)
    assert traced.policy.network == found.policy.network or traced.difference.in_double < 1e-13
    module.kind = ""
    agree(found.policy, module)


def test_a_hidden_clip_from_0_on_has_the_corner_of_relu() -> None:
    """Where an equilibrium lies on it, the rule of kinks knows which side a relu is on."""
    module = nn.Sequential(nn.Linear(2, 6, bias=False), nn.ReLU6(), nn.Linear(6, 1, bias=False)).eval()
    found = import_module(module, PLANT, SAID)
    _, relu, clip, _ = found.policy.network.network.steps
    assert isinstance(relu, Map) and relu.function == "relu"
    assert isinstance(clip, Clip) and np.all(clip.lo == -6) and np.all(clip.hi == 6)
    agree(found.policy, module)


def test_two_heads_and_weights_that_are_computed(tmp_path: Path) -> None:
    module = Policy("two heads", nn.ReLU()).eval()
    path = saved(module, "trace", tmp_path / "p.pt")
    with pytest.raises(InputError, match=r"returns 2 values.* --output 0"):
        import_policy(path, PLANT, SAID)
    with pytest.raises(InputError, match="must be a number below 2"):
        import_policy(path, PLANT, replace(SAID, output="2"))
    for found in (
        import_policy(path, PLANT, replace(SAID, output="1")),
        import_module(module, PLANT, replace(SAID, output="1")),
    ):
        agree(found.policy, module, lambda y: y[1])
        module.float()
    normed = Policy("", nn.utils.parametrizations.spectral_norm(nn.Linear(6, 6)), nn.ReLU()).eval()
    found = import_module(normed, PLANT, SAID)
    assert hasattr(normed.between[0], "parametrizations")  # the module stays as it is
    nn.utils.parametrize.remove_parametrizations(normed.between[0], "weight")
    agree(found.policy, normed)


class Written(nn.Module):  # type: ignore[misc]
    """A module by the function that it is."""

    def __init__(self, function: Any) -> None:
        super().__init__()
        self.net, self.function = nn.Linear(2, 4), function
        self.register_buffer("zero", torch.zeros(1, 2))

    def forward(self, x: Any) -> Any:
        return self.function(self, x)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda s, x: s.net(x).max(1, keepdim=True)[0], r"torch\.max .* must join one"),
        (lambda s, x: torch.tanh(torch.sqrt(s.net(x) ** 2 + 1.0)), "may only divide a value"),
        (lambda s, x: torch.sqrt(s.net(x) ** 2 + 1.0), "rows of actions"),
        (lambda s, x: torch.rsqrt(s.net(x) ** 2 + 1.0) / s.net(x), "may only divide a value"),
        (lambda s, x: s.net(torch.stack([torch.cos(x[:, 0]), x[:, 1]], 1)), r"x\[:, :1\]"),
        (lambda s, x: torch.cos(s.net(x)), "--states 'cos"),
        (lambda s, x: s.net(x)[1:], "entries of a row"),
        (lambda s, x: s.net(x)[:, ::2], "entries of a row"),
        (lambda s, x: s.net(x).view(-1, 2), "leave the rows"),
        (lambda s, x: s.net(x).mean(0, keepdim=True), r"torch\.mean"),
        (lambda s, x: s.net(x).half().float(), "float32 or float64"),
        (lambda s, x: nn.functional.dropout(s.net(x), 0.5, True), r"model\.eval\(\)"),
    ],
)
def test_what_is_read_wrongly_otherwise_is_refused(function: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        import_policy(saved(Written(function).eval(), "trace", tmp_path / "p.pt"), PLANT, SAID)


CENTRED: dict[str, tuple[Any, str]] = {
    "bare": (lambda s, x: s.net(x) - s.net(s.zero), "output"),
    "turned": (lambda s, x: -s.net(s.zero) + s.net(x), "output"),
    "like": (lambda s, x: s.net(x) - s.net(torch.zeros_like(x)), "output"),
    "row": (lambda s, x: s.net(x) - s.net(torch.zeros(1, 2, dtype=x.dtype)), "output"),
    "clipped": (lambda s, x: torch.clamp((s.net(x) - s.net(s.entries)) * 3, -2, 5), "output"),
    "moved": (lambda s, x: s.net(x) + 0.25 - s.net(s.zero) - 0.25, "output"),
    "squashed": (lambda s, x: 2 * torch.tanh(s.net(x) - s.net(s.zero)), "preactivation"),
    "beside a gain": (lambda s, x: (s.gain(x) + (s.net(x) - s.net(s.zero))).clamp(-3, 3), "output"),
    "behind a gain": (lambda s, x: torch.tanh(s.gain(x) + s.net(x) - s.net(s.zero)), "preactivation"),
    "kept at its range": (
        lambda s, x: (torch.tanh(s.net(x / 4)) - torch.tanh(s.net(s.zero))).clamp(-1.0, 1.0),
        "output",
    ),
    "shares": (lambda s, x: torch.tanh(s.net(x / 4)) - torch.tanh(s.net(s.zero)), "output"),
}
UNCENTRED: dict[str, Any] = {
    "another point": lambda s, x: s.net(x) - s.net(s.zero + 0.5),
    "another network": lambda s, x: s.net(x) - torch.tanh(s.net(s.zero)),
    "another sign": lambda s, x: s.net(x) + s.net(s.zero),
    "another input": lambda s, x: s.net(x) - s.net(s.zero) + 0.25,
    "a shift within": lambda s, x: torch.tanh(s.net(x) - s.net(s.zero) + 0.25),
    "clips of each": lambda s, x: s.net(x).clamp(-0.1, 0.1) - s.net(s.zero).clamp(-0.1, 0.1),
    "scaled clips of each": lambda s, x: 3 * s.net(x).clamp(-0.1, 0.1) - 3 * s.net(s.zero).clamp(-0.1, 0.1),
    "scaled hardtanh": lambda s, x: s.tail(s.net(x)) - s.tail(s.net(s.zero)),
    "a clip within": lambda s, x: torch.tanh((s.net(x) - s.net(s.zero)).clamp(-0.1, 0.2)),
    "one side": lambda s, x: torch.relu(s.net(x) - s.net(s.zero)),
    "at the clip": lambda s, x: torch.clamp(s.net(x) - s.net(s.zero), 0, 1),
    "beside a layer": lambda s, x: s.net[0](x)[:, :1] + s.net(x) - s.net(s.zero),
    "beside a network": lambda s, x: torch.tanh(s.gain(x)) + s.net(x) - s.net(s.zero),
    "scaled apart": lambda s, x: s.net(x) - 1.25 * s.net(s.zero),
    "twice": lambda s, x: torch.tanh(torch.tanh(s.net(x) - s.net(s.zero)) + 0.25),
    "moved before": lambda s, x: s.net(x + 0.125) - s.net(s.zero),
}


class Centred(Written):
    """The same, of a network that a file may centre."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        torch.manual_seed(8)
        self.net = nn.Sequential(nn.Linear(2, 6), nn.Tanh(), nn.Linear(6, 1))
        self.gain = nn.Linear(2, 1, bias=False)
        self.tail = nn.Hardtanh(-0.2, 0.3)
        self.register_buffer("entries", torch.zeros(2))
        self.register_buffer("one", torch.tensor([[1.0, 0.0]]))


@pytest.mark.parametrize("form", ["memory", "trace", "onnx"])
@pytest.mark.parametrize("kind", [*CENTRED, *UNCENTRED])
def test_a_file_may_centre_its_network_itself(kind: str, form: str, tmp_path: Path) -> None:
    """A network that is read at the operating point too is centred, exactly, where pi(0) = u_eq follows; else it is a
    network that reads a constant."""
    function, centre = CENTRED[kind] if kind in CENTRED else (UNCENTRED[kind], "none")
    module, path = Centred(function).eval(), tmp_path / f"p.{form}"
    if form == "memory":
        found = import_module(module, PLANT, SAID)
    elif (form, kind) == ("onnx", "like"):
        with pytest.raises(InputError, match="ConstantOfShape"):
            import_policy(saved(module, form, path), PLANT, SAID)
        return
    else:
        found = import_policy(saved(module, form, path), PLANT, SAID)
    assert found.policy.network.centre == centre
    assert ("net(o_eq)" in found.formula) == (centre != "none")
    assert ("pi(0)    u_eq = 0, exactly" in lines(found)) == (centre != "none")
    agree(found.policy, module)


def test_a_clip_at_the_range_of_tanh_acts_where_the_output_is_centred() -> None:
    """tanh(net(x)) - tanh(net(0)) leaves [-1, 1], in the file's own program and where an option asks for it."""
    module = Centred(lambda s, x: (torch.tanh(s.net(x)) - torch.tanh(s.net(s.zero))).clamp(-1.0, 1.0)).eval()
    with torch.no_grad():
        module.net[2].weight *= 20
        module.net[2].bias += 0.7 - module.net(module.zero)[0]
    found = import_module(module, PLANT, SAID).policy
    assert found.network.centre == "output" and found.network.clip is not None
    agree(found, module)
    bare = Centred(lambda s, x: torch.tanh(s.net(x)).clamp(-1.0, 1.0)).eval()
    assert import_module(bare, PLANT, SAID).policy.network.clip is None
    assert import_module(bare, PLANT, replace(SAID, centre="output")).policy.network.clip is not None
    assert import_module(bare, PLANT, replace(SAID, centre="preactivation")).policy.network.clip is None


def test_the_point_at_which_a_file_centres_is_the_operating_point() -> None:
    """The observations are 1 and 0 there; an option that says how to centre is followed."""
    module = Centred(lambda s, x: s.net(x) - s.net(s.one)).eval()
    for states, centre in (
        ("cos(theta),sin(theta)", "output"),
        ("1 + theta,theta_dot", "output"),
        ("sin(theta),cos(theta)", "none"),
        ("exp(theta_dot),tanh(theta)", "output"),
        ("theta,theta_dot", "none"),
    ):
        found = import_module(module, PLANT, replace(SAID, states=tuple(states.split(","))))
        assert found.policy.network.centre == centre
    found = import_module(module, PLANT, replace(SAID, states=("theta", "theta_dot"), centre="output"))
    assert found.policy.network.centre == "output"
    assert found.centring["output"] > 0


def test_constants_are_exact() -> None:
    var, eps = np.array([2.0, 0.1], dtype=np.float32), 1e-8
    total = computed("add", (var, eps), "it")
    assert total is not None and total[1] == Fraction(float(np.float32(0.1))) + Fraction(1e-8)
    root = computed("sqrt", (total,), "it")
    assert root is not None and all(0 <= 1 - r * r / t < Fraction(1, 2**298) for r, t in zip(root, total, strict=True))
    assert computed("sqrt", (Fraction(9, 4),), "it") == Fraction(3, 2)
    assert computed("exp", (1.0,), "it") is None
    for name, given in (("sqrt", (-1.0,)), ("div", (1, 0)), ("add", (np.ones(2), np.ones(3))), ("pow", (2.0, 0.3))):
        with pytest.raises(InputError, match="cannot be computed"):
            computed(name, given, "it")
    with pytest.raises(InputError, match="finite"):
        computed("add", (np.inf, 1.0), "it")


def test_files_of_numbers(tmp_path: Path) -> None:
    """Arrays of numpy, layers without numbers, and modules that were pickled whole are read as a state_dict is."""
    policy = Policy("", nn.ReLU()).eval()
    net = nn.Sequential(policy.first, nn.ReLU(), policy.last)
    names = {"fc1": policy.first, "mean": policy.last}
    plain = {f"{k}.{part}": getattr(layer, part).detach() for k, layer in names.items() for part in ("weight", "bias")}
    torch.save(net, tmp_path / "whole.pt")
    torch.save(plain, tmp_path / "plain.pt")
    np.savez(tmp_path / "arrays.npz", **{k: v.numpy() for k, v in net.state_dict().items()})
    flax = {
        f"params/{k}/{'kernel' if v.ndim == 2 else 'bias'}": v.numpy().T
        for k, v in ((n.split(".")[0], v) for n, v in plain.items())
    }
    np.savez(tmp_path / "flax.npz", **flax)
    for name, prefix in (
        ("arrays.npz", None),
        ("plain.pt", "fc1,mean"),
        ("flax.npz", "params.fc1,params.mean"),
    ):
        agree(import_policy(tmp_path / name, PLANT, replace(LAYERS, prefix=prefix)).policy, net)
    agree(import_policy(tmp_path / "whole.pt", PLANT, LAYERS).policy, net)
    torch.export.save(torch.export.export(net.eval(), (torch.zeros(1, 2),)), tmp_path / "program.pt2")
    with pytest.raises(InputError, match=r"is a program of torch\.export.*ONNX"):
        import_policy(tmp_path / "program.pt2", PLANT, LAYERS)
    beside = saved(net.float().eval(), "trace", tmp_path / "beside.pt")
    with zipfile.ZipFile(beside, "a") as archive:  # as _extra_files of torch.jit.save puts them there
        archive.writestr(f"{archive.namelist()[0].split('/')[0]}/extra/models/model.json", "{}")
    agree(import_policy(beside, PLANT, replace(LAYERS, activation=None, squash=None)).policy, net)
    with pytest.raises(InputError, match=r"fc1 \(2 to 6\), mean \(6 to 1\).*--prefix fc1,mean\. "):
        import_policy(tmp_path / "plain.pt", PLANT, LAYERS)
    with pytest.raises(InputError, match=r"name each layer once.*fc1 \(2 to 6\)"):
        import_policy(tmp_path / "plain.pt", PLANT, replace(LAYERS, prefix="fc1,fc2"))
    np.savez(tmp_path / "objects.npz", a=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="no plain array"):
        import_policy(tmp_path / "objects.npz", PLANT, LAYERS)
    for odd in (np.complex64, np.complex128, *([np.longdouble] if np.dtype(np.longdouble).itemsize > 8 else [])):
        arrays = {k: v.numpy().astype(odd if k == "0.bias" else np.float32) for k, v in net.state_dict().items()}
        np.savez(tmp_path / "odd.npz", **arrays)
        with pytest.raises(InputError, match=r"0\.bias.* must hold real numbers of at most 64 bits"):
            import_policy(tmp_path / "odd.npz", PLANT, LAYERS)


CHAINS: dict[str, tuple[tuple[str, ...], str, tuple[str, ...]]] = {
    "tianshou": (
        ("pre.model.0", "pre.model.2", "mu.model.0"),
        "pre.model,mu.model",
        ("sigma_param", "critic.0.weight"),
    ),
    "a layer behind": (("pi.net.0", "pi.net.2", "pi.mu"), "pi.net,pi.mu", ("pi.log_std.weight", "q1.q.0.weight")),
    "a layer before": (("first", "net.1", "net.3"), "first,net", ()),
}


def test_a_gain_is_one_layer_without_a_number(tmp_path: Path) -> None:
    """As in a file of a gain and a Lyapunov network."""
    others = {"lyapunov.0.weight": torch.ones(4, 2), "lyapunov.2.weight": torch.ones(1, 4)}
    torch.save({"policy.weight": torch.tensor([[-2.0, 3.0]])} | others, tmp_path / "p.pt")
    with pytest.raises(InputError, match=r"if the policy is policy, say so: --prefix policy\. If"):
        import_policy(tmp_path / "p.pt", PLANT, LAYERS)
    found = import_policy(tmp_path / "p.pt", PLANT, replace(LAYERS, prefix="policy"))
    assert found.policy.network(np.array([[1.0, 2.0]]), (Fraction(0),)).item() == 4
    assert set(found.not_read) == set(others)


@pytest.mark.parametrize("name", CHAINS)
def test_a_prefix_may_be_of_several_layers(name: str, tmp_path: Path) -> None:
    names, prefix, others = CHAINS[name]
    torch.manual_seed(1)
    layers = [nn.Linear(2, 6), nn.Linear(6, 5), nn.Linear(5, 1)]
    net = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])
    tensors = {
        f"{k}.{p}": getattr(one, p).detach() for k, one in zip(names, layers, strict=True) for p in ("weight", "bias")
    }
    torch.save({name: torch.ones(1, 5) for name in others} | tensors, tmp_path / "p.pt")
    with pytest.raises(InputError, match=rf"say so: --prefix {prefix}\. If"):
        import_policy(tmp_path / "p.pt", PLANT, LAYERS)
    for wrong in (f"{prefix},{names[1]}", f"{prefix},none", f"{names[0]},{names[0]}"):
        with pytest.raises(InputError, match=r"name each layer once, or the keys of some up to their numbers"):
            import_policy(tmp_path / "p.pt", PLANT, replace(LAYERS, prefix=wrong))
    found = import_policy(tmp_path / "p.pt", PLANT, replace(LAYERS, prefix=prefix))
    agree(found.policy, net)
    assert set(found.not_read) == set(others)


def twice(module: Any, inputs: Any, output: Any) -> Any:
    """A hook."""
    return 2 * output


def hooked() -> Any:
    net = nn.Sequential(nn.Linear(2, 4), nn.Tanh(), nn.Linear(4, 1))
    net[2].register_forward_hook(twice)
    return net


def layered(*between: Any, behind: tuple[Any, ...] = ()) -> Any:
    return nn.Sequential(nn.Linear(2, 4), *between, nn.Linear(4, 1), *behind)


TANH = replace(LAYERS, activation="tanh")
WHOLE: dict[str, tuple[Callable[[], Any], ImportOptions]] = {
    "plain": (lambda: layered(nn.Tanh(), nn.Dropout(0.2)), TANH),
    "squashed": (lambda: layered(nn.Tanh(), behind=(nn.Tanh(),)), replace(TANH, squash="tanh")),
    "the usual slope": (lambda: layered(nn.LeakyReLU()), replace(LAYERS, activation="leaky_relu")),
    "a slope": (lambda: layered(nn.LeakyReLU(0.2)), replace(LAYERS, activation="leaky_relu:0.2")),
    "softplus": (lambda: layered(nn.Softplus(3.0)), replace(LAYERS, activation="softplus:3")),
    "a norm": (lambda: layered(nn.LayerNorm(4), nn.Tanh()), replace(TANH, norm="layer-before")),
    "a class of its own": (lambda: Policy("", nn.ReLU()), replace(LAYERS, prefix="first,last")),
}
OTHERWISE: dict[str, tuple[Callable[[], Any], ImportOptions, str]] = {
    "another function": (lambda: layered(nn.ReLU()), TANH, "module 1 is relu; --activation says tanh"),
    "another end": (lambda: layered(nn.Tanh(), behind=(nn.Tanh(),)), LAYERS, "1 is tanh; --activation says relu"),
    "no function between": (
        lambda: nn.Sequential(nn.Linear(2, 4), nn.Linear(4, 4), nn.Tanh(), nn.Linear(4, 1)),
        TANH,
        "must be layers with tanh between each two",
    ),
    "two functions between": (lambda: layered(nn.Tanh(), nn.Tanh()), TANH, "must be layers with tanh between"),
    "a function before": (lambda: nn.Sequential(nn.Tanh(), nn.Linear(2, 1)), TANH, "must be layers with tanh between"),
    "an end that is not said": (lambda: layered(nn.Tanh(), behind=(nn.Tanh(),)), TANH, "behind the last nothing or"),
    "a slope that is not said": (lambda: layered(nn.LeakyReLU(0.2)), replace(LAYERS, activation="leaky_relu"), r"0\.2"),
    "another slope": (lambda: layered(nn.LeakyReLU(0.2)), replace(LAYERS, activation="leaky_relu:0.1"), r"slope 0\.2"),
    "a threshold": (lambda: layered(nn.Softplus(1, 2)), replace(LAYERS, activation="softplus:1"), "Softplus, of which"),
    "a module that is not read": (lambda: layered(nn.Tanh(), behind=(nn.Softmax(-1),)), TANH, "Softmax, of which no"),
    "a norm without numbers": (
        lambda: layered(nn.LayerNorm(4, elementwise_affine=False), nn.Tanh()), TANH, "LayerNorm, of which no",
    ),
    "another epsilon": (
        lambda: layered(nn.LayerNorm(4, eps=0.1), nn.Tanh()), replace(TANH, norm="layer-before"), "with --norm-eps",
    ),
    "a hook": (hooked, TANH, "must have no hooks"),
}  # fmt: skip


@pytest.mark.parametrize("name", WHOLE)
def test_modules_that_were_pickled_whole(name: str, tmp_path: Path) -> None:
    """In each form of torch.save and of pickle, and beside another network in a dictionary."""
    torch.manual_seed(3)
    module, path = WHOLE[name][0]().eval(), tmp_path / "p.pt"
    options = WHOLE[name][1]
    for k in range(4):
        if k < 2:
            torch.save(module, path, _use_new_zipfile_serialization=bool(k))
        else:
            path.write_bytes(pickle.dumps(module if k == 2 else {"critic": nn.Sequential(nn.ReLU()), "pi": module}))
        prefix = options.prefix if k < 3 or options.prefix is None else "pi.first,pi.last"
        found = import_policy(
            path, PLANT, replace(options, prefix=prefix, ignore=("*mean", "*var", "*most") if prefix else None)
        )
        agree(found.policy, module)
        assert "forward is not in the file" in found.assumed
        module.float()


def test_a_module_with_two_names_has_its_tensors_under_both(tmp_path: Path) -> None:
    """As in a state_dict: without those of the first layer, the second would be a network of its own."""
    net = nn.Module()
    net.first = nn.Linear(2, 2)
    net.net = nn.Sequential(net.first, nn.Tanh(), nn.Linear(2, 1))
    torch.save(net, tmp_path / "p.pt")
    found = import_policy(tmp_path / "p.pt", PLANT, replace(TANH, prefix="net", ignore=("first.*",)))
    agree(found.policy, net.net)
    actor = Policy("", nn.Tanh())
    actor.max_action = 2.0
    torch.save({"actor": actor}, tmp_path / "q.pt")
    options = replace(TANH, prefix="actor.first,actor.last", ignore=("actor.m*", "actor.var"))
    assert "nor the part in it of actor.max_action = 2" in import_policy(tmp_path / "q.pt", PLANT, options).assumed
    net.own = net
    (tmp_path / "p.pt").write_bytes(pickle.dumps(net))
    with pytest.raises(InputError, match="at most 1,000 modules"):
        import_policy(tmp_path / "p.pt", PLANT, TANH)


@pytest.mark.parametrize("name", OTHERWISE)
def test_modules_that_are_not_what_is_said_are_refused(name: str, tmp_path: Path) -> None:
    made, options, message = OTHERWISE[name]
    torch.save(made(), tmp_path / "p.pt")
    with pytest.raises(InputError, match=message):
        import_policy(tmp_path / "p.pt", PLANT, options)


def test_arrays_that_do_not_say_which_way_they_go_are_listed(tmp_path: Path) -> None:
    arrays = {"fc1_w": np.ones((2, 2)), "fc1_b": np.ones(2), "mean": np.ones(2), "stddev": np.ones(2)}
    np.savez(tmp_path / "p.npz", **arrays)
    with pytest.raises(InputError, match=r"none in fc1_w \(2, 2\), fc1_b \(2,\), .*kernel \(in, out\)"):
        import_policy(tmp_path / "p.npz", PLANT, LAYERS)


def test_a_normaliser_under_other_names_is_not_ignored(tmp_path: Path) -> None:
    arrays = {"0.weight": np.ones((1, 2)), "0.bias": np.ones(1), "mean": np.ones(2), "stddev": 2 * np.ones(2)}
    np.savez(tmp_path / "p.npz", **arrays)
    with pytest.raises(
        InputError, match=r"mean and stddev .* obs\._mean and obs\._std, and add --epsilon 0"
    ) as refused:
        import_policy(tmp_path / "p.npz", PLANT, LAYERS)
    assert "--ignore" not in str(refused.value)
    names = {"mean": "obs._mean", "stddev": "obs._std"}
    np.savez(tmp_path / "p.npz", **{names.get(k, k): v for k, v in arrays.items()})
    options = replace(LAYERS, normaliser=None, epsilon=Fraction(0))
    found = import_policy(tmp_path / "p.npz", PLANT, options).policy
    assert np.array_equal(found.network(np.array([[3.0, 5.0]]), (Fraction(0),)), [[(3 - 1) / 2 + (5 - 1) / 2 + 1]])
    with pytest.raises(InputError, match=r"K \(1,\), mean .*say so: --ignore K\. "):
        np.savez(tmp_path / "p.npz", **arrays, K=np.ones(1))
        import_policy(tmp_path / "p.npz", PLANT, LAYERS)


class Shared(nn.Module):  # type: ignore[misc]
    """Memory that is written in one place and read in another, or numbers that a conversion rounds."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        torch.manual_seed(5)
        self.kind = kind
        self.a, self.b = nn.Linear(2, 6), nn.Linear(3 if kind == "whole" else 6, 1)
        self.register_buffer("whole", torch.zeros(6, dtype=torch.int64))
        self.register_buffer("short", torch.zeros(6, dtype=torch.float16))
        self.register_buffer("plain", torch.ones(6))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = self.a(x)
        if self.kind == "part":
            h[:, :3].tanh_()
        elif self.kind == "whole":
            p = h[:, :3]
            h.tanh_()
            h = p
        elif self.kind == "constant":
            h = h * self.plain.mul_(0.5) + self.plain
        elif self.kind == "integers":
            h = h.type_as(self.whole).float()
        elif self.kind == "half":
            h = h.type_as(self.short).float()
        result: torch.Tensor = self.b(h)
        return result


@pytest.mark.parametrize("how", ["trace", "script"])
@pytest.mark.parametrize("kind", ["part", "whole", "constant", "integers", "half"])
def test_what_is_written_elsewhere_or_rounded_is_refused(kind: str, how: str, tmp_path: Path) -> None:
    """A reading of values alone would take what is no longer there, and so would the comparison with it."""
    path = saved(Shared(kind).eval(), how, tmp_path / "p.pt")
    with pytest.raises(InputError, match=r"overwrit|of constants alone|conversion to float32 or float64"):
        import_policy(path, PLANT, SAID)


class FromThird(nn.Module):  # type: ignore[misc]
    """The entries from the third on, which a script writes without their end."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(6)
        self.a, self.b = nn.Linear(2, 6), nn.Linear(3, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        result: torch.Tensor = self.b(torch.tanh(self.a(x))[:, 3:])
        return result


def test_a_part_without_an_end_is_read(tmp_path: Path) -> None:
    module = FromThird().eval()
    agree(import_policy(saved(module, "script", tmp_path / "p.pt"), PLANT, SAID).policy, module)


def brax(path: Path, outputs: int = 2) -> Any:
    """Parameters as Brax has them, flattened with numpy: kernels (in, out) of hidden_0, hidden_1; mean, then spread."""
    module = nn.Sequential(nn.Linear(2, 6), nn.SiLU(), nn.Linear(6, outputs))
    named = {f"policy/params/hidden_{k}": module[2 * k] for k in range(2)}
    arrays = {f"{name}/kernel": layer.weight.detach().numpy().T for name, layer in named.items()}
    np.savez(path, **arrays, **{f"{name}/bias": layer.bias.detach().numpy() for name, layer in named.items()})
    return module


BRAX = replace(SAID, squash="tanh", activation="silu", prefix="policy.params.hidden_0,policy.params.hidden_1")


def test_the_mean_of_what_gives_the_spread_as_well(tmp_path: Path) -> None:
    torch.manual_seed(7)
    module, path = brax(tmp_path / "p.npz"), tmp_path / "p.npz"
    found = import_policy(path, PLANT, replace(BRAX, output="mean"))
    assert "first 1 are the mean" in found.assumed
    agree(found.policy, module, lambda y: torch.tanh(y[:, :1]))
    torch.save(module.state_dict(), tmp_path / "p.pt")  # found by its sizes
    for each, prefix in ((path, BRAX.prefix), (tmp_path / "p.pt", None)):
        with pytest.raises(InputError, match=r"it gives 2\. .* --output mean"):
            import_policy(each, PLANT, replace(BRAX, prefix=prefix))
    found = import_policy(tmp_path / "p.pt", PLANT, replace(BRAX, output="mean", prefix=None))
    agree(found.policy, module.float(), lambda y: torch.tanh(y[:, :1]))
    for outputs in (1, 3, 4):
        brax(path, outputs)
        with pytest.raises(InputError, match=f"2 numbers for 1 inputs; it gives {outputs}"):
            import_policy(path, PLANT, replace(BRAX, output="mean"))


def test_the_places_of_the_actions_in_what_the_last_layer_gives(tmp_path: Path) -> None:
    """RLlib has the spread of each action of a tuple behind it."""
    torch.manual_seed(8)
    path = tmp_path / "p.npz"
    module = brax(path, 4)
    for place in (0, 2, 3):
        found = import_policy(path, PLANT, replace(BRAX, output=str(place)))
        assert f"numbers {place}, counted from 0, are the actions" in found.assumed
        agree(found.policy, module, lambda y, k=place: torch.tanh(y[:, k : k + 1]))
    torch.save(module.state_dict(), tmp_path / "p.pt")  # found by its sizes
    found = import_policy(tmp_path / "p.pt", PLANT, replace(BRAX, output="2", prefix=None))
    agree(found.policy, module.float(), lambda y: torch.tanh(y[:, 2:3]))
    for each, prefix in ((path, BRAX.prefix), (tmp_path / "p.pt", None)):
        with pytest.raises(InputError, match=r"--output 4 takes the numbers 4 of .*; it gives 4"):
            import_policy(each, PLANT, replace(BRAX, output="4", prefix=prefix))
    for said in ("", "-1", "0,2", "0,0", "0,00", "1.0", "first", "\u0662"):
        with pytest.raises(InputError, match="must be mean, or the place of each of 1 actions"):
            import_policy(path, PLANT, replace(BRAX, output=said))


@pytest.mark.parametrize("prefix", [None, "first,last"])
@pytest.mark.parametrize(
    "norm",
    [nn.utils.weight_norm, nn.utils.parametrizations.weight_norm, nn.utils.parametrizations.spectral_norm],
)
@pytest.mark.filterwarnings("ignore:.*weight_norm.* is deprecated:FutureWarning")
def test_a_file_of_computed_weights_names_what_writes_them_out(tmp_path: Path, norm: Any, prefix: str | None) -> None:
    """Where no layer has a plain weight none is found, and the reason is told."""
    module = nn.ModuleDict(
        {name: norm(nn.Linear(2, 1) if name == "last" else nn.Linear(2, 2)) for name in ("first", "last")}
    )
    torch.save(module.eval().state_dict(), tmp_path / "p.pt")
    with pytest.raises(InputError, match=r"belongs to is computed\. Write the weights out before you save it"):
        import_policy(tmp_path / "p.pt", PLANT, replace(LAYERS, prefix=prefix))
