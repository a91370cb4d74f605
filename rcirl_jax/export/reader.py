"""Reader of `weights.msgpack`, the learned reward. Needs numpy and msgpack only.

This one file may be copied into a planner's repository. docs/weights_format.md
gives the byte layout; the equation is

    x_t = (clip(f_t, lower, upper) - location) / scale       f [T, F]
    x_t <- x_t * 2 / (1 + exp(-x_0 C))                       with scene gating only
    r_t = act(... act(x_t W_1 + b_1) ...) W_L + b_L          last layer linear
    V   = sum_t gamma_t * time_valid_t * r_t                 higher is better

A reward with a prior cost is driven on the planner's own cost:

    V_total = V_incumbent + gain V    where V knows the scene, else V_incumbent

It does not where a feature that never varied in training (`unsupported`) has another
value at the first time: nobody was recorded there.

    reward = load_weights("weights.msgpack")
    print(reward.describe())             # what it was trained for, and what not
    reward.check_features(names, units)  # the planner's columns, in its order
    values = reward.value(features)      # [K] of features [K, T, F]

A value says nothing of safety: choose among candidates that a safety filter admits, as
`choose` of `own_planner/choose.py` does.
"""

import dataclasses
import hashlib
import math
import os
from collections.abc import Callable, Iterable, Sequence
from itertools import zip_longest
from typing import Any, NoReturn

import msgpack
import numpy as np

MAGIC = "RCIRLW"  # first value of the outer map
SCHEMA_VERSION = 1  # the layout that this reader knows
TOLERANCE = 1e-5  # of max(1, |V|), on a verification sample, float32

# Limits, far above any sensible reward (the paper's network is 21 -> 15 -> 1).
MAX_FILE_BYTES = 64 * 2**20  # bytes
MAX_FEATURES = 64  # F
MAX_TIMES = 256  # T
MAX_LAYERS = 16  # L
MAX_UNITS = 4096  # outputs of one layer
MAX_SAMPLES = 256  # verification samples
MAX_NAME = 64  # characters of a name or unit
MAX_TEXT = 2**16  # bytes of any other string
MAX_ITEMS = 4096  # entries of one list or map
MAX_NODES = 2**16  # entries of all lists and maps of a file together
MAX_DEPTH = 8  # levels of lists and maps, `provenance` itself the first

OUTER_KEYS = ("magic", "schema_version", "body", "sha256")
AXES = {
    **{"F": MAX_FEATURES, "T": MAX_TIMES, "m": MAX_SAMPLES},
    **{"in": MAX_UNITS, "out": MAX_UNITS},
}
RANGES = dict.fromkeys(("lower", "upper", "location", "scale"), "F")
# The body, in the order of its keys: the one description of the file, for this reader
# and for the writer. A map has these keys and no others; a list, rows of one kind; what
# stands in a tuple may be nil. An array is named by its axes: one name, one length.
BODY: dict[str, Any] = {
    "preset": "text",
    "features": [{"name": "text", "unit": "text", "none_value": "number"}],
    "normaliser": RANGES,
    "training_range": "2 F",
    "times": "T",
    "gamma": "T",
    "layers": [{"kernel": "in out", "bias": "out"}],
    "activation": "text",
    "leaky_slope": "number",
    "scene_gating": ("F F",),
    "prior_cost": ({"incumbent": "text", "gain": "number"},),
    "loss": {"name": "text", "leaky_rate": ("number",)},
    "provenance": "plain",
    "samples": {"features": "m T F", "valid": "m T", "value": "m"},
}
ACTIVATIONS: dict[str, Callable[[np.ndarray, np.float32], np.ndarray]] = {
    "tanh": lambda x, slope: np.tanh(x),
    "relu": lambda x, slope: np.maximum(x, np.float32(0.0)),
    "leaky_relu": lambda x, slope: np.where(x > 0.0, x, slope * x),
    "identity": lambda x, slope: x,
}


class WeightsError(ValueError):
    """The file, or what was asked of it, is wrong. One printable line."""

    def __init__(self, message: str) -> None:
        line = " ".join(str(message).split())
        super().__init__("".join(c if c.isprintable() else "?" for c in line))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PriorCost:
    """The value that V is added to, and how much of V."""

    incumbent: str  # whose value it is, at most 64 characters
    gain: float  # > 0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Reward:
    """A reward in its effective weights. Of a file: verified, arrays read-only."""

    file: str = ""
    sha256: str = ""  # of the body; names this reward
    preset: str  # of data_specs/features
    names: tuple[str, ...]  # [F]
    units: tuple[str, ...]  # [F] SI; "1" for a pure number
    none_values: tuple[float, ...]  # [F] a feature's value when nothing is there
    lower: np.ndarray  # [F] in the feature's unit
    upper: np.ndarray  # [F]
    location: np.ndarray  # [F]
    scale: np.ndarray  # [F] > 0
    times: np.ndarray  # [T] s, increasing from 0
    gamma: np.ndarray  # [T]
    kernels: tuple[np.ndarray, ...]  # [F, H1], ..., [H, 1]
    biases: tuple[np.ndarray, ...]  # [H1], ..., [1]
    activation: str  # of the hidden layers, one of ACTIVATIONS
    leaky_slope: float  # negative slope of "leaky_relu"
    scene_gating: np.ndarray | None = None  # [F, F] C, the scene gating
    training_range: np.ndarray  # [2, F] ends of the training's range
    prior_cost: PriorCost | None = None  # drives on top of an incumbent, by `total`
    loss: dict[str, Any]  # name; leaky_rate of the rank loss, or None
    provenance: dict[str, Any]

    def __repr__(self) -> str:
        """Return the file, features, layers and loss: arrays would fill pages."""
        layers = [self.kernels[0].shape[0], *(x.shape[1] for x in self.kernels)]
        prior = ", on a prior cost" if self.prior_cost is not None else ""
        return (
            f"Reward({self.file or 'made here'}: {self.preset}, layers "
            f"{'-'.join(map(str, layers))}, loss {self.loss.get('name')}{prior}, "
            f"sha256 {self.sha256[:16]})"
        )

    @property
    def mode(self) -> str:
        """Return what candidates may differ in.

        Returns:
          "speed": in s(t) along one path; l was not trained. "path_speed": in l too.
        """
        mode = self.provenance.get("mode", "speed")
        return "path_speed" if mode == "path_speed" else "speed"

    @property
    def unsupported(self) -> tuple[str, ...]:
        """Return features without effect: the training never saw them vary."""
        empty = zip(self.names, self.lower >= self.upper, strict=True)
        return tuple(name for name, none in empty if none)

    def describe(self) -> str:
        """Return lines on what the values mean and what they do not, for a log."""
        prior, last = self.prior_cost, float(self.times[-1])
        lateral = "l was not trained" if self.mode == "speed" else "l was trained"
        lines = (
            f"mode: {self.mode}: {lateral}",
            f"features without effect: {', '.join(self.unsupported) or 'none'}",
            "prior cost: "
            + (f"{prior.incumbent}, gain {_show(prior.gain)}" if prior else "none"),
            f"times: {len(self.times)} from 0 to {_show(last)} s",
            "safety: none: filter the candidates before you choose",
        )
        return "\n".join(lines)

    def check_features(self, names: Sequence[str], units: Sequence[str]) -> None:
        """Refuse columns that are not the file's, in the file's order and units."""
        own = zip(self.names, self.units, strict=True)
        pairs = zip_longest(zip_longest(names, units), own, fillvalue="none")
        for index, (found, wanted) in enumerate(pairs):
            if found != wanted:
                _fail(f"{self.file}: features[{index}]", found, str(wanted))

    def value(
        self, features: np.ndarray, time_valid: np.ndarray | None = None
    ) -> np.ndarray:
        """Return V of trajectories; higher is better.

        Args:
          features: [..., T, F] raw features at `times`.
          time_valid: [..., T] of 0 and 1, broadcast to the leading axes; None: all
            valid. Only trajectories that share it have comparable values.

        Returns:
          float32 [...]. A value that is not finite raises: `argmax` would pick a
          NaN. Features at times that are not valid may be anything. The first time
          has to be valid in a reward with scene gating: it sets the gates.
        """
        numbers = self._numbers(features, (len(self.times), len(self.names)))
        valid = None if time_valid is None else self._mask(time_valid, numbers.shape)
        if self.scene_gating is not None and valid is not None:
            self._needs_first(valid)
        return self._finite("value", self._values(numbers, valid), "finite features")

    def total(
        self,
        features: np.ndarray,
        incumbent: np.ndarray,
        time_valid: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return V_incumbent + gain V of trajectories; higher is better.

        V counts where it knows the scene: at the first time, if that is valid, every
        feature of `unsupported` is within its scale of its location. Elsewhere the
        total is V_incumbent.

        Args:
          features: as `value`.
          incumbent: [...] the incumbent's values (its cost, negated), broadcast to
            the leading axes of the features.
          time_valid: as `value`.

        Returns:
          float32 [...]. Raises as `value`, without a prior cost, and for a sum or an
          incumbent's value that is not finite.
        """
        if self.prior_cost is None:
            _fail(f"{self.file}: prior_cost", None, "a reward with a prior cost")
        values = self.value(features, time_valid)
        try:
            others = np.broadcast_to(np.asarray(incumbent), values.shape)
        except (TypeError, ValueError) as error:
            _fail(f"{self.file}: incumbent", error, f"numbers of shape {values.shape}")
        if others.dtype.kind not in "fiu":
            _fail(f"{self.file}: incumbent", others.dtype, "numbers")
        with np.errstate(all="ignore"):
            added = self.prior_cost.gain * values.astype(float)
            added = np.where(self._knows(np.asarray(features), time_valid), added, 0.0)
            total = others.astype(np.float32) + added
            total = np.asarray(total).astype(np.float32)
        return self._finite("total", total, "finite values of the incumbent")

    def _knows(self, features: np.ndarray, time_valid: np.ndarray | None) -> np.ndarray:
        first = features[..., 0, :].astype(np.float32)
        other = np.abs(first - self.location) > self.scale
        other = np.any(other & (self.lower >= self.upper), axis=-1)
        return (
            ~other if time_valid is None else ~(other & np.asarray(time_valid)[..., 0])
        )

    def _finite(self, name: str, values: np.ndarray, expected: str) -> np.ndarray:
        bad = np.argwhere(~np.isfinite(values)).tolist()
        if bad:
            _fail(f"{self.file}: {name}{bad[0]}", "not finite", expected)
        return values

    def _needs_first(self, valid: np.ndarray) -> None:
        if not valid[..., 0].all():
            _fail(f"{self.file}: time_valid", "0 at the first time", "1: gates need it")

    @np.errstate(all="ignore")
    def _values(self, features: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
        x = (np.clip(features, self.lower, self.upper) - self.location) / self.scale
        if self.scene_gating is not None:
            x = x * (
                np.float32(2.0) / (1.0 + np.exp(-(x[..., :1, :] @ self.scene_gating)))
            )
        activate, slope = ACTIVATIONS[self.activation], np.float32(self.leaky_slope)
        for kernel, bias in zip(self.kernels[:-1], self.biases[:-1], strict=True):
            x = activate(x @ kernel + bias, slope)
        terms = self.gamma * (x @ self.kernels[-1] + self.biases[-1])[..., 0]
        if valid is not None:
            terms = np.where(valid, terms, np.float32(0.0))
        return np.asarray(np.sum(terms, axis=-1, dtype=np.float32))

    def _numbers(self, given: np.ndarray, last: tuple[int, ...]) -> np.ndarray:
        wanted = f"numbers of shape [..., {', '.join(map(str, last))}]"
        try:
            array = np.asarray(given)
        except (TypeError, ValueError) as error:
            _fail(f"{self.file}: features", error, wanted)
        if array.dtype.kind not in "fiu" or array.shape[-len(last) :] != last:
            _fail(f"{self.file}: features", f"{array.dtype} {array.shape}", wanted)
        with np.errstate(all="ignore"):
            return array.astype(np.float32)

    def _mask(self, given: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        wanted = f"0 and 1, to broadcast to {shape[:-1]}"
        try:
            mask = np.broadcast_to(np.asarray(given), shape[:-1])
        except (TypeError, ValueError) as error:
            _fail(f"{self.file}: time_valid", error, wanted)
        if mask.dtype.kind not in "biuf" or not np.all((mask == 0) | (mask == 1)):
            _fail(f"{self.file}: time_valid", f"{mask.dtype} of other values", wanted)
        return mask.astype(bool)


def load_weights(path: str | os.PathLike[str]) -> Reward:
    """Read and verify one file.

    Raises:
      WeightsError: the file is missing, damaged, of another version, out of
        range, or does not reproduce its own verification samples.

    Examples:
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> features = np.tile(reward.none_values, (3, 18, 1))  # three, nothing near
        >>> features[:, :, reward.names.index("velocity")] = [[8.0], [14.0], [25.0]]
        >>> reward.value(features).shape
        (3,)
    """
    try:
        file = os.fsdecode(path)
        if not os.path.isfile(file):
            raise FileNotFoundError("no such file")
        with open(file, "rb") as stream:
            # One byte more than allowed: an oversize file is seen, not read.
            data = stream.read(MAX_FILE_BYTES + 1)
    except (OSError, TypeError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise WeightsError(f"{path}: path: {why}: expected a file") from None
    return decode_weights(data, file)


def decode_weights(data: bytes, file: str = "weights") -> Reward:
    """Decode as `load_weights`, from bytes; `file` is their name in messages."""
    try:
        return _decode(data, file)
    except WeightsError as error:
        raise WeightsError(f"{file}: {error}") from None


def _decode(data: bytes, file: str) -> Reward:
    if not 1 <= len(data) <= MAX_FILE_BYTES:
        _fail("size", f"{len(data)} bytes or more", f"1 to {MAX_FILE_BYTES} bytes")
    outer = _unpack("file", data)
    if not isinstance(outer, dict) or outer.get("magic") != MAGIC:
        _fail("magic", "missing or another", repr(MAGIC))
    version = outer.get("schema_version")
    if type(version) is not int or version != SCHEMA_VERSION:
        _fail("schema_version", version, f"{SCHEMA_VERSION}, all this reader supports")
    _map("file", outer, OUTER_KEYS)
    body = outer["body"]
    found = hashlib.sha256(body).hexdigest() if isinstance(body, bytes) else "no bytes"
    if outer["sha256"] != found or not isinstance(body, bytes):
        _fail("sha256", found, f"{_show(outer['sha256'])}; the file is damaged")
    fields = _read("body", _unpack("body", body), BODY, {})
    reward = _reward(file, found, fields)
    _verify(reward, fields["samples"])
    return reward


def _read(field: str, value: Any, kind: Any, axes: dict[str, int]) -> Any:  # noqa: ANN401
    """Return what stands in a field, checked against its kind in `BODY`.

    Args:
      field: its place, for messages.
      value: as unpacked.
      kind: text, number, plain, the axes of an array, or a structure of these.
      axes: lengths of the axes met so far; those of this field are added.
    """
    if isinstance(kind, tuple):
        return None if value is None else _read(field, value, kind[0], axes)
    if isinstance(kind, dict):
        at = "" if field == "body" else f"{field}."
        box = _map(field, value, tuple(kind))
        return {k: _read(f"{at}{k}", box[k], kind[k], axes) for k in kind}
    if isinstance(kind, list):
        most = MAX_FEATURES if field == "features" else MAX_LAYERS
        if not isinstance(value, list) or not 1 <= len(value) <= most:
            _fail(field, value, f"a list of 1 to {most}")
        if field == "features":
            axes |= {"F": len(value), "out": len(value)}
        rows = []
        for index, row in enumerate(value):
            if "out" in axes:  # a layer takes what the one before gives
                axes["in"] = axes.pop("out")
            rows.append(_read(f"{field}[{index}]", row, kind[0], axes))
        return rows
    if kind == "text":
        if not isinstance(value, str) or not 1 <= len(value) <= MAX_NAME:
            _fail(field, value, f"a text of 1 to {MAX_NAME} characters")
        return value
    if kind == "number":
        return _number(field, value)
    if kind == "plain":
        return _plain(field, value, MAX_DEPTH)
    return _array(field, value, kind.split(), axes)


def _reward(file: str, sha256: str, body: dict[str, Any]) -> Reward:
    """Return the reward of a body, whose values are checked against each other."""
    names, units, none_values = zip(
        *(row.values() for row in body["features"]), strict=True
    )
    for index, name in enumerate(names):
        if name in names[:index]:
            _fail(f"features[{index}].name", name, "a name used once")
    ranges, times, seen = (body[k] for k in ("normaliser", "times", "training_range"))
    lower, upper, _, scale = ranges.values()
    kernels, biases = zip(*(row.values() for row in body["layers"]), strict=True)
    width = kernels[-1].shape[1]
    if width != 1:
        _fail(f"layers[{len(kernels) - 1}].kernel", width, "1 output, the reward")
    if body["activation"] not in ACTIVATIONS:
        _fail("activation", body["activation"], f"one of {', '.join(ACTIVATIONS)}")
    prior = body["prior_cost"]
    if prior is not None:
        if prior["gain"] <= 0.0:
            _fail("prior_cost.gain", prior["gain"], "above 0")
        prior = PriorCost(**prior)
    _every("normaliser.lower", lower, lower <= upper, "at most upper")
    _every("normaliser.scale", scale, scale > 0.0, "over 0")
    _every("times", times[:1], times[:1] == 0.0, "0 s first")
    _every("times", times[1:], times[1:] > times[:-1], "increasing times")
    _every("training_range", seen[:1], seen[:1] <= seen[1:], "at most the highest")
    named = ("features", "normaliser", "layers", "prior_cost", "samples")
    return Reward(
        file=file,
        sha256=sha256,
        names=names,
        units=units,
        none_values=none_values,
        **ranges,
        kernels=kernels,
        biases=biases,
        prior_cost=prior,
        **{key: value for key, value in body.items() if key not in named},
    )


def _plain(field: str, value: Any, depth: int) -> Any:  # noqa: ANN401
    """Check a map of what JSON can say: texts, finite numbers, lists, maps."""
    if depth == MAX_DEPTH and not isinstance(value, dict):
        _fail(field, value, "a map")
    if isinstance(value, dict | list) and depth > 0:
        for item in value.values() if isinstance(value, dict) else value:
            _plain(field, item, depth - 1)
    elif not isinstance(value, str | bool | None):
        _number(field, value, f"texts, finite numbers, {MAX_DEPTH} levels at most")
    return value


def _verify(reward: Reward, samples: dict[str, Any]) -> None:
    """Check that the file's samples score as the file says."""
    features, valid, wanted = samples.values()
    _every("samples.valid", valid, (valid == 0.0) | (valid == 1.0), "0 or 1")
    if reward.scene_gating is not None:
        first = valid[:, :1]
        _every("samples.valid", first, first == 1.0, "1 at the first time")
    # One sample at a time: little memory, however wide the layers are.
    for index, one in enumerate(zip(features, valid == 1.0, wanted, strict=True)):
        scored, want = float(reward._values(*one[:2])), float(one[2])
        if not abs(scored - want) <= TOLERANCE * max(1.0, abs(want)):
            need = f"{want:.9g} within {TOLERANCE:g} of max(1, |V|)"
            _fail(f"samples[{index}]", f"scored {scored:.9g}", need)


def _unpack(field: str, data: bytes) -> object:
    """Unpack one msgpack object, nothing behind it; no ext types, bounded memory."""
    nodes = 0

    def on_list(items: list[Any]) -> list[Any]:
        nonlocal nodes
        nodes += 1 + len(items)
        if nodes > MAX_NODES:
            _fail(field, "too many entries", f"at most {MAX_NODES}")
        return items

    def on_map(pairs: Iterable[tuple[Any, Any]]) -> dict[str, Any]:
        entries = on_list(list(pairs))  # older msgpack without its C part: an iterator
        result = dict(entries)
        if len(result) != len(entries) or not all(isinstance(k, str) for k in result):
            _fail(field, "a key used twice or not a text", "text keys, each once")
        return result

    try:
        return msgpack.unpackb(
            data,
            raw=False,
            strict_map_key=True,
            object_pairs_hook=on_map,
            list_hook=on_list,
            max_str_len=MAX_TEXT,
            max_bin_len=MAX_FILE_BYTES,
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
            max_ext_len=0,
        )
    except WeightsError:
        raise
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        _fail(field, f"{type(error).__name__} {error}", "one whole msgpack map")


def _show(value: object) -> str:
    """Return a value as short text; never the inside of a list, map or bytes."""
    if isinstance(value, dict | list | bytes):
        return f"{type(value).__name__} of {len(value)}"
    text = f"{value:.9g}" if isinstance(value, float | np.floating) else str(value)
    return text if len(text) <= 96 else text[:93] + "..."


def _fail(field: str, value: object, expected: str) -> NoReturn:
    raise WeightsError(f"{field}: {_show(value)}: expected {expected}")


def _map(field: str, value: object, keys: tuple[str, ...]) -> dict[str, Any]:
    """Return a map with exactly these keys."""
    if not isinstance(value, dict):
        _fail(field, value, "a map")
    for key in (*keys, *value):
        if key not in value or key not in keys:
            found = "unknown" if key in value else "missing"
            _fail(f"{field}.{_show(key)}", found, f"the keys {', '.join(keys)}")
    return value


def _number(field: str, value: Any, expected: str = "a finite number") -> float:  # noqa: ANN401
    if type(value) not in (int, float) or not math.isfinite(value):
        _fail(field, value, expected)
    return float(value)


def _array(
    field: str, value: object, names: Sequence[str], axes: dict[str, int]
) -> np.ndarray:
    """Return a finite float32 array whose axes have these names, or lengths."""
    box = _map(field, value, ("shape", "dtype", "data"))
    shape, data = box["shape"], box["data"]
    if box["dtype"] != "<f4":
        _fail(f"{field}.dtype", box["dtype"], "<f4")
    lengths = [int(n) if n.isdigit() else axes.get(n) for n in names]
    most = [n or AXES[name] for n, name in zip(lengths, names, strict=True)]
    least = [n or 1 for n in lengths]
    fits = isinstance(shape, list) and len(shape) == len(names)
    pairs = zip(shape, least, most, strict=True) if fits else [(shape, 0, 0)]
    if not all(type(n) is int and low <= n <= high for n, low, high in pairs):
        ends = zip(least, most, strict=True)
        need = ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in ends)
        _fail(f"{field}.shape", str(shape[:8]) if fits else shape, f"[{need}]")
    axes |= {name: n for name, n in zip(names, shape, strict=True) if name in AXES}
    if not isinstance(data, bytes) or len(data) != 4 * math.prod(shape):
        _fail(f"{field}.data", data, f"{4 * math.prod(shape)} bytes")
    array = np.frombuffer(data, "<f4").reshape(shape).astype(np.float32)
    array.flags.writeable = False
    _every(field, array, np.isfinite(array), "finite numbers")
    return array


def _every(field: str, values: np.ndarray, good: np.ndarray, expected: str) -> None:
    if not good.all():
        at = np.argwhere(~good)[0].tolist()
        _fail(f"{field}{at}", values[tuple(at)], expected)
