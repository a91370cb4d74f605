"""Files that no reader takes, and the field that each names: of Python and of C++.

`FIELDS` are of the body of a valid file: the path of one, another value, a part of the
line. `FILES` are whole ones.
"""

import hashlib
from typing import cast

import msgpack
import numpy as np

from tests.helpers.weights_files import packed

VALID = packed()
WITH_PRIOR = packed(with_prior=True)
GATED = packed(scene_gating=True)


def dump(value) -> bytes:
    return cast("bytes", msgpack.packb(value))


def array(*shape, fill=1.0):
    data = np.full(shape, fill, "<f4").tobytes()
    return {"shape": list(shape), "dtype": "<f4", "data": data}


def sealed(body, /, **outer):
    """A file with this body and the right hash."""
    body = body if isinstance(body, bytes) else dump(body)
    digest = hashlib.sha256(body).hexdigest()
    head = {"magic": "RCIRLW", "schema_version": 1, "body": body, "sha256": digest}
    return dump({**head, **outer})


def body_of(data=VALID):
    return msgpack.unpackb(msgpack.unpackb(data)["body"])


def tampered(path, value, data=None):
    """A valid file with one field of its body replaced, and hashed again."""
    data = data or (WITH_PRIOR if path[0] == "prior_cost" else VALID)
    body = body_of(data)
    *way, last = path
    place = body
    for step in way:
        place = place[step]
    place[last] = value
    return sealed(body)


def flipped(data, bits):
    changed = bytearray(data)
    for bit in bits:
        changed[bit // 8] ^= 1 << (bit % 8)
    return bytes(changed)


PRIOR_COST_FIELDS = (
    ([], {}, "prior_cost.incumbent: missing: expected the keys incumbent, gain"),
    (["extra"], 1, "prior_cost.extra: unknown: expected the keys incumbent, gain"),
    (["incumbent"], 5, "prior_cost.incumbent: 5: expected a text"),
    (["gain"], -0.5, "prior_cost.gain: -0.5: expected above 0"),
    (["gain"], 0, "prior_cost.gain: 0: expected above 0"),
    (["gain"], "1", "prior_cost.gain: 1: expected a finite number"),
)
FIELDS = (
    (["preset"], 5, "preset: 5: expected a text"),
    (["features"], {}, "features: dict of 0: expected a list of 1 to 64"),
    (["features"], [1], "features[0]: 1: expected a map"),
    (["features", 1, "name"], "feature0", "features[1].name: feature0: expected a"),
    (["features", 1, "unit"], "", "features[1].unit: : expected a text"),
    (["features", 1, "none_value"], True, "none_value: True: expected a finite"),
    (["normaliser", "scale"], array(3, fill=0.0), "normaliser.scale[0]: 0"),
    (["normaliser", "upper"], array(3, fill=-99.0), "normaliser.lower[0]"),
    (["times"], array(4), "times[0]: 1: expected 0 s first"),
    (["times"], array(4, fill=0.0), "times[0]: 0: expected increasing"),
    (["times"], array(257), "times.shape: [257]: expected"),
    (["gamma"], array(3), "gamma.shape: [3]: expected [4]"),
    (["gamma", "shape"], "four", "gamma.shape: four: expected [4]"),
    (["gamma", "shape"], [2**63], "gamma.shape: [9223372036854775808]"),
    (["gamma", "dtype"], ">f4", "gamma.dtype: >f4: expected <f4"),
    (["gamma", "data"], b"\0" * 15, "gamma.data: bytes of 15: expected 16 bytes"),
    (["gamma", "data"], "x" * 16, "gamma.data: xxxxxxxxxxxxxxxx: expected 16"),
    (["gamma"], array(4, fill=np.inf), "gamma[0]: inf: expected finite numbers"),
    (["layers"], [], "layers: list of 0: expected a list of 1 to 16"),
    (["layers", 0, "kernel"], array(2, 5), "kernel.shape: [2, 5]: expected [3, "),
    (["layers", 1, "kernel"], array(4, 1), "layers[1].kernel.shape: [4, 1]: expe"),
    (["layers", 1], {"kernel": array(5, 2), "bias": array(2)}, "expected 1 output"),
    (["layers", 0, "kernel"], array(3, 4097), "kernel.shape: [3, 4097]: expected"),
    (["activation"], "gelu", "activation: gelu: expected one of tanh, relu"),
    (["leaky_slope"], float("nan"), "leaky_slope: nan: expected a finite number"),
    (["loss"], {"name": "rank"}, "loss.leaky_rate: missing"),
    (["provenance"], [], "provenance: list of 0: expected a map"),
    (["provenance", "x"], b"1", "provenance: bytes of 1: expected texts, finite"),
    (["provenance", "x"], [[[[[[[[]]]]]]]], "provenance: list of 0: expected"),
    (["provenance", "x"], [0] * 4097, "exceeds max_array_len"),
    (["provenance", "x"], [[0] * 4000] * 17, "too many entries: expected at most"),
    (["provenance", "x"], "x" * 70_000, "exceeds max_str_len"),
    (["provenance", "x"], msgpack.Timestamp(1), "exceeds max_ext_len"),
    (["provenance", b"x"], 1, "a key used twice or not a text"),
    (["samples"], {}, "samples.features: missing"),
    (["samples", "value"], array(4, fill=99.0), "samples[0]: scored"),
    (["samples", "value"], array(257), "samples.value.shape: [257]"),
    (["samples", "valid"], array(4, 4, fill=0.5), "samples.valid[0, 0]: 0.5"),
    (["samples", "features"], array(4, 4, 2), "features.shape: [4, 4, 2]: expe"),
    (["extra"], 1, "body.extra: unknown: expected the keys preset"),
    (["training_range"], array(1, 3), "training_range.shape: [1, 3]: expected [2, 3]"),
    (["scene_gating"], array(1, 2), "scene_gating.shape: [1, 2]: expected [3, 3]"),
    (["samples", "gain"], array(4), "samples.gain: unknown: expected the keys"),
    *((["prior_cost", *path], value, line) for path, value, line in PRIOR_COST_FIELDS),
)


LATER = "schema_version: 2: expected 1, all this reader supports"
FILES = (
    (b"", "size: 0 bytes or more: expected 1 to 67108864 bytes"),
    (VALID[:-1], "file: ValueError Unpack failed: incomplete input: expected one"),
    (VALID + VALID, "file: ExtraData"),
    (b"not a weights file", "file: ExtraData"),
    (b"\xc1", "file: FormatError"),
    (b"\x91" * 5000, "file: "),
    (b"\xdd\xff\xff\xff\xff", "file: ValueError 4294967295 exceeds max_array_len"),
    (dump([1]), "magic: missing or another: expected 'RCIRLW'"),
    (dump({1: 1}), "file: ValueError int is not allowed for map key"),
    (b"\x82\xa1a\x01\xa1a\x02", "file: a key used twice"),
    (sealed(body_of(), magic="RCIRLX"), "magic: missing or another"),
    # whatever a later version adds, its number is what is named
    (sealed(b"later", schema_version=2, signature="x"), LATER),
    (sealed({**body_of(), "seen": 1}), "body.seen: unknown: expected the keys preset"),
    (
        tampered(["training_range", "data"], np.arange(6, 0, -1, "<f4").tobytes()),
        "training_range[0, 0]: 6: expected at most the highest",
    ),
    (
        tampered(["samples", "valid"], array(4, 4, fill=0.0), GATED),
        "samples.valid[0, 0]: 0: expected 1 at the first time",
    ),
    (sealed(body_of(), schema_version=True), "schema_version: True: expected 1, all"),
    (sealed(body_of(), extra=1), "file.extra: unknown"),
    (sealed(body_of(), sha256="0" * 64), "sha256: "),
    (sealed(body_of(), sha256=5), "expected 5; the file is damaged"),
    (sealed(body_of(), body="text", sha256="no bytes"), "sha256: no bytes"),
    (sealed(b""), "body: ValueError"),
    (sealed(dump(body_of()) + b"\0"), "body: ExtraData"),
    (sealed([1]), "body: list of 1: expected a map"),
)
