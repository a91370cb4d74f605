"""Reader of `weights.msgpack`, the learned reward. Needs numpy and msgpack only.

This one file may be copied into a planner's repository. docs/weights_format.md
gives the byte layout; the equation is

    x_t = (clip(f_t, lower, upper) - location) / scale       f [T, F]
    x_t <- x_t * 2 / (1 + exp(-x_0 C))                       with scene gating only
    r_t = act(... act(x_t W_1 + b_1) ...) W_L + b_L          last layer linear
    V   = sum_t gamma_t * time_valid_t * r_t                 higher is better

A reward with a prior cost is driven on the planner's own cost, with a gain that
depends on how familiar the scene is:

    V_total = V_incumbent + gain V
    gain    = low + (high - low) sigmoid(out . tanh(z W + b) + c)
    z_i     = clip((f_0i - location_i) / scale_i, -5, 5)      f_0 raw, location of it

    reward = load_weights("weights.msgpack")
    reward.check_features(names, units)  # the planner's columns, in its order
    best = int(np.argmax(reward.value(features)))  # features [K, T, F]
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
TOLERANCE = 1e-5  # of max(1, |V|), on a verification sample, float32; of gains too
REACH = 5.0  # scales from the location beyond which a prior cost's inputs are clipped

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
RANGES = ("lower", "upper", "location", "scale")
FAMILIARITY_KEYS = ("location", "scale", "kernel", "bias", "out", "offset")
PRIOR_COST_KEYS = ("incumbent", "low", "high", "familiarity")
SAMPLE_KEYS = ("features", "valid", "value", "gain")
BODY_KEYS = (
    *("preset", "features", "normaliser", "training_range", "times", "gamma"),
    *("layers", "activation", "leaky_slope", "scene_gating", "prior_cost"),
    *("loss", "provenance", "samples"),
)
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


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PriorCost:
    """How much of V is added to the incumbent's value, by the scene's familiarity."""

    incumbent: str  # whose value V is added to, at most 64 characters
    low: float  # gain where the training data do not reach, >= 0
    high: float  # where they do, >= low
    location: np.ndarray  # [F] in the feature's unit
    scale: np.ndarray  # [F] > 0
    kernel: np.ndarray  # [F, H] W; a feature whose row is 0 does not matter
    bias: np.ndarray  # [H] b
    out: np.ndarray  # [H]
    offset: np.ndarray  # [1] c

    @np.errstate(all="ignore")
    def gain(self, first: np.ndarray) -> np.ndarray:
        """Return gains of V, summed in float64.

        Args:
          first: [..., F] raw features at the first time.

        Returns:
          float32 [...]; a NaN among the features that matter gives NaN.
        """
        z = np.clip((first - self.location.astype(float)) / self.scale, -REACH, REACH)
        z = np.where(self.kernel.any(axis=1), z, 0.0)
        hidden = np.tanh(z @ self.kernel + self.bias)
        share = 1.0 / (1.0 + np.exp(-(hidden @ self.out + self.offset[0])))
        return np.asarray(self.low + (self.high - self.low) * share).astype(np.float32)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Reward:
    """A verified reward. Arrays are float32 and read-only."""

    file: str
    sha256: str  # of the body; names this reward
    preset: str
    names: tuple[str, ...]  # [F]
    units: tuple[str, ...]  # [F]
    none_values: tuple[float, ...]  # [F] a feature's value when nothing is there
    lower: np.ndarray  # [F] in the feature's unit
    upper: np.ndarray  # [F]
    location: np.ndarray  # [F]
    scale: np.ndarray  # [F] > 0
    times: np.ndarray  # [T] s, from 0
    gamma: np.ndarray  # [T]
    kernels: tuple[np.ndarray, ...]  # [F, H1], ..., [H, 1]
    biases: tuple[np.ndarray, ...]  # [H1], ..., [1]
    activation: str
    leaky_slope: float  # negative slope of "leaky_relu"
    scene_gating: np.ndarray | None  # [F, F] C, the scene gating
    training_range: np.ndarray  # [2, F] ends of the training's range
    prior_cost: PriorCost | None  # drives on top of an incumbent, by `total`
    loss: dict[str, Any]
    provenance: dict[str, Any]

    @property
    def unsupported(self) -> tuple[str, ...]:
        """Return features without effect: the training never saw them vary."""
        empty = zip(self.names, self.lower >= self.upper, strict=True)
        return tuple(name for name, none in empty if none)

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

    def gain(self, features: np.ndarray) -> np.ndarray:
        """Return how much of V is added to the value of the prior cost.

        Args:
          features: [..., T, F] raw features at `times`; the first time counts.

        Returns:
          float32 [...] in [low, high]. A reward without a prior cost raises, and a NaN
          among the features that matter (whose row of the kernel is not 0).
        """
        if self.prior_cost is None:
            _fail(f"{self.file}: prior_cost", None, "a reward with a prior cost")
        numbers = self._numbers(features, (len(self.times), len(self.names)))
        gains = self.prior_cost.gain(numbers[..., 0, :])
        return self._finite("gain", gains, "finite features at the first time")

    def total(
        self,
        features: np.ndarray,
        incumbent: np.ndarray,
        time_valid: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return V_incumbent + gain V of trajectories; higher is better.

        Args:
          features: as `value`.
          incumbent: [...] the incumbent's values (its cost, negated), broadcast to
            the leading axes of the features.
          time_valid: as `value`; the first time has to be valid.

        Returns:
          float32 [...]. Raises as `value` and `gain`, and for a sum or an
          incumbent's value that is not finite.
        """
        gains = self.gain(features)
        if time_valid is not None:
            shape = (*gains.shape, len(self.times), len(self.names))
            self._needs_first(self._mask(time_valid, shape))
        values = self.value(features, time_valid)
        try:
            others = np.broadcast_to(np.asarray(incumbent), gains.shape)
        except (TypeError, ValueError) as error:
            _fail(f"{self.file}: incumbent", error, f"numbers of shape {gains.shape}")
        if others.dtype.kind not in "fiu":
            _fail(f"{self.file}: incumbent", others.dtype, "numbers")
        with np.errstate(all="ignore"):
            total = others.astype(np.float32) + gains.astype(float) * values
            total = np.asarray(total).astype(np.float32)
        return self._finite("total", total, "finite values of the incumbent")

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
        x = self._normalise(features)
        if self.scene_gating is not None:
            x = x * (
                np.float32(2.0) / (1.0 + np.exp(-(x[..., :1, :] @ self.scene_gating)))
            )
        terms = self.gamma * self._network(x)
        if valid is not None:
            terms = np.where(valid, terms, np.float32(0.0))
        return np.asarray(np.sum(terms, axis=-1, dtype=np.float32))

    @np.errstate(all="ignore")
    def _normalise(self, features: np.ndarray) -> np.ndarray:
        return (np.clip(features, self.lower, self.upper) - self.location) / self.scale

    @np.errstate(all="ignore")
    def _network(self, x: np.ndarray) -> np.ndarray:
        activate, slope = ACTIVATIONS[self.activation], np.float32(self.leaky_slope)
        for kernel, bias in zip(self.kernels[:-1], self.biases[:-1], strict=True):
            x = activate(x @ kernel + bias, slope)
        return (x @ self.kernels[-1] + self.biases[-1])[..., 0]

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
        raise WeightsError(f"{path}: path: {error}: expected a file") from None
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
    fields = _map("body", _unpack("body", body), BODY_KEYS)
    reward = Reward(file=file, sha256=found, **_fields(fields))
    _verify(reward, fields["samples"])
    return reward


def _fields(body: dict[str, Any]) -> dict[str, Any]:
    """Return every field of `Reward` that comes from the body, checked."""
    features = _features(body["features"])
    size = len(features["names"])
    boxes = _map("normaliser", body["normaliser"], RANGES)
    ranges = {key: _array(f"normaliser.{key}", boxes[key], (size,)) for key in RANGES}
    lower, upper, _, scale = ranges.values()
    _every("normaliser.lower", lower, lower <= upper, "at most upper")
    _every("normaliser.scale", scale, scale > 0.0, "over 0")
    times = _array("times", body["times"], (range(1, MAX_TIMES + 1),))
    _every("times", times[:1], times[:1] == 0.0, "0 s first")
    _every("times", times[1:], times[1:] > times[:-1], "increasing times")
    activation = _text("activation", body["activation"])
    if activation not in ACTIVATIONS:
        _fail("activation", activation, f"one of {', '.join(ACTIVATIONS)}")
    scene_gating, prior_cost = body["scene_gating"], body["prior_cost"]
    if scene_gating is not None:
        scene_gating = _array("scene_gating", scene_gating, (size, size))
    training_range = _array("training_range", body["training_range"], (2, size))
    _every(
        "training_range",
        training_range[:1],
        training_range[:1] <= training_range[1:],
        "at most the highest",
    )
    loss = _map("loss", body["loss"], ("name", "leaky_rate"))
    _text("loss.name", loss["name"])
    if loss["leaky_rate"] is not None:
        _number("loss.leaky_rate", loss["leaky_rate"])
    return {
        "preset": _text("preset", body["preset"]),
        **features,
        **ranges,
        "times": times,
        "gamma": _array("gamma", body["gamma"], (len(times),)),
        **_layers(body["layers"], size),
        "activation": activation,
        "leaky_slope": _number("leaky_slope", body["leaky_slope"]),
        "scene_gating": scene_gating,
        "training_range": training_range,
        "prior_cost": None if prior_cost is None else _prior_cost(prior_cost, size),
        "loss": loss,
        "provenance": _plain("provenance", body["provenance"], MAX_DEPTH),
    }


def _features(value: object) -> dict[str, tuple[Any, ...]]:
    rows = []
    for index, row in enumerate(_list("features", value, MAX_FEATURES)):
        at = f"features[{index}]"
        row = _map(at, row, ("name", "unit", "none_value"))
        name, unit = _text(f"{at}.name", row["name"]), _text(f"{at}.unit", row["unit"])
        if name in [before for before, _, _ in rows]:
            _fail(f"{at}.name", name, "a name used once")
        rows.append((name, unit, _number(f"{at}.none_value", row["none_value"])))
    names, units, none_values = zip(*rows, strict=True)
    return {"names": names, "units": units, "none_values": none_values}


def _layers(value: object, width: int) -> dict[str, tuple[np.ndarray, ...]]:
    """Return the chain F -> ... -> 1."""
    kernels, biases = [], []
    for index, row in enumerate(_list("layers", value, MAX_LAYERS)):
        at = f"layers[{index}]"
        row = _map(at, row, ("kernel", "bias"))
        shape = (width, range(1, MAX_UNITS + 1))
        kernels.append(_array(f"{at}.kernel", row["kernel"], shape))
        width = kernels[-1].shape[1]
        biases.append(_array(f"{at}.bias", row["bias"], (width,)))
    if width != 1:
        _fail(f"layers[{len(kernels) - 1}].kernel", width, "1 output, the reward")
    return {"kernels": tuple(kernels), "biases": tuple(biases)}


def _prior_cost(value: object, features: int) -> PriorCost:
    """Return the prior cost, checked but for the gains of the samples."""
    box = _map("prior_cost", value, PRIOR_COST_KEYS)
    text = _text("prior_cost.incumbent", box["incumbent"])
    low, high = (_number(f"prior_cost.{key}", box[key]) for key in ("low", "high"))
    if low < 0.0:
        _fail("prior_cost.low", low, "at least 0")
    if high < low:
        _fail("prior_cost.high", high, f"at least low, {_show(low)}")
    at = "prior_cost.familiarity"
    box = _map(at, box["familiarity"], FAMILIARITY_KEYS)
    read = lambda key, *shape: _array(f"{at}.{key}", box[key], shape)  # noqa: E731
    location, scale = read("location", features), read("scale", features)
    kernel = read("kernel", features, range(1, MAX_UNITS + 1))
    _every(f"{at}.scale", scale, scale > 0.0, "over 0")
    units = kernel.shape[1]
    return PriorCost(
        incumbent=text,
        low=low,
        high=high,
        location=location,
        scale=scale,
        kernel=kernel,
        bias=read("bias", units),
        out=read("out", units),
        offset=read("offset", 1),
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


def _verify(reward: Reward, samples: object) -> None:
    """Check that the file's samples score, and have gains, as the file says."""
    found = _map("samples", samples, SAMPLE_KEYS)
    wanted = _array("samples.value", found["value"], (range(1, MAX_SAMPLES + 1),))
    shape = (len(wanted), len(reward.times), len(reward.names))
    features = _array("samples.features", found["features"], shape)
    valid = _array("samples.valid", found["valid"], shape[:2])
    _every("samples.valid", valid, (valid == 0.0) | (valid == 1.0), "0 or 1")
    if reward.scene_gating is not None or reward.prior_cost is not None:
        first = valid[:, :1]
        _every("samples.valid", first, first == 1.0, "1 at the first time")
    # One sample at a time: little memory, however wide the layers are.
    for index, one in enumerate(zip(features, valid == 1.0, wanted, strict=True)):
        scored, want = float(reward._values(*one[:2])), float(one[2])
        if not abs(scored - want) <= TOLERANCE * max(1.0, abs(want)):
            need = f"{want:.9g} within {TOLERANCE:g} of max(1, |V|)"
            _fail(f"samples[{index}]", f"scored {scored:.9g}", need)
    if reward.prior_cost is None:
        if found["gain"] is not None:
            _fail("samples.gain", found["gain"], "none without a prior cost")
        return
    gains = _array("samples.gain", found["gain"], (len(wanted),))
    with np.errstate(all="ignore"):
        error = np.abs(reward.prior_cost.gain(features[:, 0]).astype(float) - gains)
    good = error <= TOLERANCE * np.maximum(1.0, np.abs(gains))
    _every("samples.gain", gains, good, "the gain of the sample")


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


def _list(field: str, value: object, most: int) -> list[Any]:
    if not isinstance(value, list) or not 1 <= len(value) <= most:
        _fail(field, value, f"a list of 1 to {most}")
    return value


def _text(field: str, value: object) -> str:
    if not isinstance(value, str) or not 1 <= len(value) <= MAX_NAME:
        _fail(field, value, f"a text of 1 to {MAX_NAME} characters")
    return value


def _number(field: str, value: Any, expected: str = "a finite number") -> float:  # noqa: ANN401
    if type(value) not in (int, float) or not math.isfinite(value):
        _fail(field, value, expected)
    return float(value)


def _array(field: str, value: object, shape: tuple[int | range, ...]) -> np.ndarray:
    """Return a finite float32 array; an axis has a length or limits."""
    box = _map(field, value, ("shape", "dtype", "data"))
    axes, data = box["shape"], box["data"]
    if box["dtype"] != "<f4":
        _fail(f"{field}.dtype", box["dtype"], "<f4")
    limits = [want if isinstance(want, range) else (want,) for want in shape]
    fits = isinstance(axes, list) and len(axes) == len(shape)
    pairs = zip(axes, limits, strict=True) if fits else [(axes, ())]
    if not all(type(n) is int and n in limit for n, limit in pairs):
        _fail(f"{field}.shape", str(axes[:8]) if fits else axes, str(list(shape)))
    if not isinstance(data, bytes) or len(data) != 4 * math.prod(axes):
        _fail(f"{field}.data", data, f"{4 * math.prod(axes)} bytes")
    array = np.frombuffer(data, "<f4").reshape(axes).astype(np.float32)
    array.flags.writeable = False
    _every(field, array, np.isfinite(array), "finite numbers")
    return array


def _every(field: str, values: np.ndarray, good: np.ndarray, expected: str) -> None:
    if not good.all():
        at = np.argwhere(~good)[0].tolist()
        _fail(f"{field}{at}", values[tuple(at)], expected)
