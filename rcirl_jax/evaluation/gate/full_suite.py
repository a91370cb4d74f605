"""The suite that a candidate has to drive to ship: families, cases, their files.

The list is part of the code, so that a folder of other scenarios is another suite. Who
changes a family on purpose enters what the test of this module prints.
"""

from collections.abc import Iterable, Mapping

from rcirl_jax.runtime.pipeline import digest
from rcirl_jax.runtime.specs import load_toml, spec_root

# cases of each family
FAMILIES: Mapping[str, int] = dict.fromkeys(
    (
        *("aggressive", "compound_city", "compound_highway", "crossing_car"),
        *("curve_speed", "cut_in", "cut_out", "cyclist", "free_cruise", "lane_change"),
        *("lead_brakes", "merge", "noisy_perception", "nudge", "overtake_parked"),
        *("pedestrian", "red_light", "roundabout", "stop_and_go", "stop_sign"),
        *("stopped_lead", "traffic", "unprotected_left"),
    ),
    180,
)
SHA256 = "2ec5c5d42658391808d4f2a160e1c3d18ab42c2766bddbf9ce45a6471820a39f"


def families_sha256(names: Iterable[str]) -> str:
    """Returns the sha256 of what the files of families say, comments not counted."""
    folder = spec_root() / "scenarios"
    return digest({name: load_toml(folder / f"{name}.toml") for name in names})


def left_out_of_suite(cases: Iterable[tuple[str, int]]) -> str:
    """Says how cases depart from the full suite; "" if they are all of it.

    Args:
      cases: family and number of each, of any catalogue seed.
    """
    full = {(name, i) for name, count in FAMILIES.items() for i in range(count)}
    driven = set(cases)
    if missing := len(full - driven):
        return f"{len(driven):,} cases, {missing:,} of the full suite's left out"
    if beyond := sorted({name for name, _ in driven - full}):
        return f"another suite: {', '.join(beyond)}: cases beyond those of the full one"
    if families_sha256(FAMILIES) != SHA256:
        return "another suite: the families' files are not those of the full one"
    return ""
