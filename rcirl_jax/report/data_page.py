"""The page of an import: sites, counts, drops, labels, scenes.

The page is a single file that refers to no other and needs no script: the scenes
are filtered by radio buttons and style sheets alone.
"""

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import tqdm

from rcirl_jax.data.drawing import draw_site
from rcirl_jax.data.plans import facts_of
from rcirl_jax.data.quality import oddities
from rcirl_jax.data.scenes.filters import REASONS
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import MALFORMED, InputError, counted
from rcirl_jax.report.pages import Table, facts_text, part, write_page
from rcirl_jax.report.scene import describe_scene, draw_scene, spoken, tag_names
from rcirl_jax.types import Tag

TAG_NAMES = tuple(tag.name.lower() for tag in Tag)


def choose_rows(tags: np.ndarray, count: int, wanted: Sequence[str] = ()) -> list[int]:
    """Choose rows worth looking at: every tag in turn, spread over the dataset.

    Args:
      tags: [n, len(Tag)] bool, of all rows.
      count: rows to choose at most.
      wanted: names of tags; only rows with one of them are chosen. All if empty.

    Returns:
      Row numbers in ascending order; the same ones each time.

    Raises:
      InputError: an unknown tag, or no row has a wanted one.
    """
    for name in wanted:
        if name not in TAG_NAMES:
            raise InputError(f"tags: {name}: expected {', '.join(TAG_NAMES)}")
    names = tuple(wanted) or TAG_NAMES
    queues = [_spread(np.flatnonzero(tags[:, TAG_NAMES.index(n)])) for n in names]
    if not wanted:
        queues.append(_spread(np.flatnonzero(~tags.any(axis=1))))
    chosen: dict[int, None] = {}
    while len(chosen) < count and any(queues):
        for queue in queues:
            while queue and queue[0] in chosen:
                queue.pop(0)
            if queue and len(chosen) < count:
                chosen[queue.pop(0)] = None
    if not chosen:
        raise InputError(f"tags: {','.join(wanted)}: no such scene in the dataset")
    return sorted(chosen)


def _spread(rows: np.ndarray) -> list[int]:
    """Order rows so that each prefix is spread over all of them (bit reversal)."""
    bits = max(int(rows.size - 1).bit_length(), 1)
    order = [int(f"{number:0{bits}b}"[::-1], 2) for number in range(2**bits)]
    return [int(rows[at]) for at in order if at < rows.size]


def write_data_page(
    output: Path,
    dataset: Dataset,
    rows: Sequence[int],
    title: str,
    facts: Mapping[str, object],
) -> Path:
    """Draw the scenes into `scenes` beside the page, and write the page.

    Args:
      output: HTML file.
      dataset: what is shown.
      rows: scenes that are drawn.
      title: heading, e.g. the dataset's name.
      facts: what made the page: commit, versions, flags.

    Raises:
      InputError: a row the dataset does not have, or one that cannot be drawn.
    """
    missing = [row for row in rows if not 0 <= row < dataset.count]
    if missing:
        raise InputError(f"rows: {missing[0]}: expected 0 to {dataset.count - 1}")
    quality = dataset.manifest.quality
    scenes = _scenes(output.parent / "scenes", dataset, rows)
    present = [
        (name, spoken(name), sum(name in one["tags"] for one in scenes))
        for name in TAG_NAMES
    ]
    return write_page(
        output,
        "data.html",
        title=title,
        lead=f"{dataset.count:,} scenes of {quality['tracks']:,} road users in "
        f"{quality['recordings']:,} recordings. Each scene is a moment of a human "
        "driver with what the human then did; labels say what was decided about each "
        "road user.",
        tags=TAG_NAMES,
        sites=_sites(dataset),
        num_recordings=len(dataset.manifest.recordings),
        facts=_facts(dataset),
        drops=_drops(quality),
        tag_counts=_counts("scenes with a tag", quality["tags"], dataset.count),
        decisions=_counts(
            "labels", quality["decisions"], sum(quality["decisions"].values())
        ),
        headways=_headways(quality),
        scenes=scenes,
        present=[one for one in present if one[2]],
        notes=quality["notes"],
        num_notes=quality["num_notes"],
        made_by=_provenance(dataset),
        page_facts=facts_text(facts),
    )


def _sites(dataset: Dataset) -> list[dict]:
    """Draw the plan of each site that the dataset has; with its facts and notes."""
    found = []
    try:
        for plan in dataset.plans():
            drawn = io.BytesIO()
            draw_site(plan).savefig(drawn, dpi=110, format="png")
            data = base64.b64encode(drawn.getvalue()).decode()
            words, notes = facts_of(plan), plan["notes"]
            one = {"name": plan["name"], "data": data, "words": words, "notes": notes}
            found.append(one)
    except MALFORMED as error:
        raise InputError(
            f"plans.json: {error}: expected plans of `rcirl import`"
        ) from error
    return found


def _scenes(folder: Path, dataset: Dataset, rows: Sequence[int]) -> list[dict]:
    """Draw each row; return it with its tags and words."""
    manifest, loaded = dataset.manifest, dataset.read(np.asarray(rows, np.int64))
    found = []
    for place, row in enumerate(tqdm.tqdm(rows, desc="draw", unit=" scenes")):
        scene = jax.tree.map(lambda x, at=place: x[at], loaded)
        path = draw_scene(folder / f"scene{row:07d}.png", scene, row)
        found.append(
            {
                "data": base64.b64encode(path.read_bytes()).decode(),
                "tags": tag_names(scene),
                "where": f"recording {manifest.recordings[int(scene.recording)]}, "
                f"vehicle {manifest.vehicles[int(scene.vehicle)]}, frame "
                f"{int(scene.frame)}",
                "words": describe_scene(scene, row),
            }
        )
    return found


def _facts(dataset: Dataset) -> Table:
    manifest, quality = dataset.manifest, dataset.manifest.quality
    rates = ", ".join(f"{rate:g}" for rate in manifest.rate_hz)
    rows = [
        ("sampling rate", f"{rates} Hz"),
        ("states", f"{quality['states']:,}"),
        (
            f"|a| > {quality['harsh_threshold_mps2']:g} m/s²",
            f"{quality['harsh_share_raw']:.1%} as recorded, "
            f"{quality['harsh_share_smoothed']:.1%} smoothed",
        ),
    ]
    for key, name, unit in (
        ("speed_mps", "speed at the planning frame", "m/s"),
        ("headway_s", "headway behind the followed", "s"),
        ("future_s", "recorded future", "s"),
    ):
        found = quality[key]
        if found is not None:
            words = f"{found['p50']:.1f} {unit} ({found['p05']:.1f} to "
            rows.append((name, f"{words}{found['p95']:.1f} in 90 %)"))
    if quality.get("shortened"):
        words = (
            f"{quality['shortened']:,} scenes, {quality['shortened_share']:.1%} of the "
            "recorded futures: someone whom the driver reacts to leaves the record"
        )
        rows.append(("end before the driver's record", words))
    rows += [(words, "") for words in oddities(quality)]
    for split, groups in manifest.splits.items():
        count = dataset.indices(split).size
        words = (
            f"{count:,} scenes in {counted(len(groups), 'group')} of vehicles; no "
            "vehicle is in both splits"
        )
        rows.append((f"split {split}", words))
    if "split_by" in manifest.import_flags:
        rows.append(("split by", manifest.import_flags["split_by"]))
    for source in manifest.sources:
        words = f"{source.get('source', '')}; licence: {source.get('licence', '')}"
        rows.append(("source", words))
    return Table(caption="", heads=("", ""), rows=rows, kind="words")


def _drops(quality: Mapping) -> Table:
    dropped = quality["dropped"]
    total = max(sum(dropped.values()) + quality["scenes"], 1)
    counts = sorted(dropped.items(), key=lambda item: -item[1])
    rows = [
        (spoken(name), f"{count:,}", part("bar", count / total), REASONS.get(name, ""))
        for name, count in [*counts, ("kept", quality["scenes"])]
    ]
    heads = ("reason", "count", "", "meaning")
    return Table(caption="", heads=heads, rows=rows, kind="words")


def _counts(caption: str, counts: Mapping[str, int], total: int) -> Table:
    rows = [
        (
            spoken(name),
            f"{count:,}",
            f"{count / max(total, 1):.1%}",
            part("bar", count / max(total, 1)),
        )
        for name, count in sorted(counts.items(), key=lambda item: -item[1])
    ]
    return Table(caption=caption, heads=("", "count", "share", ""), rows=rows)


def _headways(quality: Mapping) -> Table | None:
    found = quality["headway_histogram"]
    if not sum(found.values()):
        return None
    most = max(found.values())
    rows = [
        (name.replace("-inf", " and more"), f"{count:,}", part("bar", count / most))
        for name, count in found.items()
    ]
    return Table(caption="", heads=("", "scenes", ""), rows=rows)


def _provenance(dataset: Dataset) -> str:
    flags = dataset.manifest.import_flags
    lines = [f"dataset sha256: {dataset.hash}"]
    lines += [f"{name}: {value}" for name, value in sorted(flags.items())]
    made_by = dataset.facts().get("made_by")
    made_by = made_by if isinstance(made_by, dict) else {}
    lines += [
        f"{name}: {made_by.get(name) or 'not said'}"
        for name in ("git_commit", "code_sha256", "versions")
    ]
    return "\n".join(lines)
