"""Options that the source TOML of a user's table may have: others are refused."""

from collections.abc import Mapping, Sequence

from rcirl_jax.data.importers.options import section
from rcirl_jax.data.recording import LEAVE_OUT, PIECE
from rcirl_jax.errors import InputError, did_you_mean

OPTIONS = (
    *("source", "licence", "pattern", "rate_hz", "speed_limit", "lane_width_m"),
    *("reference_point", "max_bad_rows", "heading_convention", "automated_values"),
    *("long_bytes", "columns", "units", "scale", "offset", "defaults", "kinds"),
    *("lanes", "table"),
)
ADDED = (LEAVE_OUT, PIECE, "log_names")  # by an import
DEFAULTS = ("rate_hz", "length", "width", "kind")
LANE = ("id", "points", "width", "speed_limit", "left", "right", "successors")
LANE_FILE = ("file",)


def check_options(spec: Mapping) -> None:
    """Options of a source TOML are known, also those of [defaults] and of lanes.

    Raises:
      InputError: one is not.
    """
    for name in spec:
        if name not in ADDED:
            check_known("source TOML: ", name, OPTIONS)
    for name in section(spec, "defaults"):
        check_known("source TOML: defaults.", name, DEFAULTS)
    lanes = spec.get("lanes", [])
    if isinstance(lanes, dict):
        for name in lanes:
            check_known("source TOML: lanes.", name, LANE_FILE)
        return
    every = lanes if isinstance(lanes, list) else []
    for lane in (lane for lane in every if isinstance(lane, dict)):
        for name in lane:
            check_known(f"source TOML: lanes {lane.get('id', '')}: ", name, LANE)


def check_known(where: str, name: str, known: Sequence[str]) -> None:
    """A name is one of those known.

    Raises:
      InputError: it is not.
    """
    if name not in known:
        raise InputError(
            f"{where}{name}: unknown: expected one of {', '.join(known)}"
            f"{did_you_mean(name, known)}"
        )
