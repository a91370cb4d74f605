"""The data-quality report of an import: counts, noise, headways, labels, drops."""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.scenes.collect import Collector
from rcirl_jax.data.scenes.filters import REASONS, REMEDIES
from rcirl_jax.data.scenes.lines import TOO_FEW
from rcirl_jax.data.scenes.tracks import HARSH_MPS2, harsh_share, note_of
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import counted
from rcirl_jax.types import Decision, Demonstration, Kind, Recording, RowCounts, Tag

HEADWAY_STEP_S = 0.01  # s, to which headways are counted
SPEED_STEP_MPS = 0.05  # m/s, likewise
FUTURE_STEP_S = 0.05  # s, likewise
HEADWAY_EDGES_S = (0.5, 1.0, 1.5, 2.0, 3.0)  # s, bins of the headway histogram
NOTES_SHOWN = 3  # in the report that is printed; the manifest has more
# what a log may leave to a guess
LIMIT, WIDTH, SIZE = "speed limit", "width", "size"
HOW_TO_POOL = (
    "written lights that the crossings of one file cannot bear out give no stop "
    "labels: `--signals=pooled` of an import asks the drivers of all files together"
)


@dataclasses.dataclass
class QualityReport:
    """Accumulates over recordings; `as_dict` is what the manifest stores."""

    recordings: int = 0
    tracks: int = 0
    states: int = 0
    scenes: int = 0
    harsh_raw: int = 0
    harsh_smooth: int = 0
    accelerations: int = 0
    shortened: int = 0  # scenes that end with their surroundings
    times: int = 0  # points of the time axis inside the scenes' recorded futures
    times_cut: int = 0  # of them after the surroundings' end
    dropped: Counter = dataclasses.field(default_factory=Counter)
    tags: Counter = dataclasses.field(default_factory=Counter)
    decisions: Counter = dataclasses.field(default_factory=Counter)
    # how often each multiple of a step was met; the key is the multiple as text
    headways: Counter = dataclasses.field(default_factory=Counter)
    speeds: Counter = dataclasses.field(default_factory=Counter)
    futures: Counter = dataclasses.field(default_factory=Counter)
    # of tables: rows read, and dropped by why
    rows: Counter = dataclasses.field(default_factory=Counter)
    # tracks joined or left out, by why
    flicker: Counter = dataclasses.field(default_factory=Counter)
    # of each recording's name and the note, what matters most first
    notes: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    refused: int = 0  # recordings left out
    empty: int = 0  # recordings without traffic
    # lanes without a speed limit or width, road users without a size, and all of them
    assumed: Counter = dataclasses.field(default_factory=Counter)

    def add_nothing(self, recording: Recording) -> None:
        """Count and note a recording that is left out, or in which nobody drives."""
        if recording.refused:
            self.refused += 1
            self.notes.append(("left out", recording.refused))
        else:
            self.empty += 1
            notes = ("no traffic", *recording.notes)
            self.notes += [(recording.name, note) for note in notes]

    def add_recording(self, collector: Collector) -> None:
        """Count a recording's tracks, noise, drop reasons and notes."""
        recording = collector.recording
        self.recordings += 1
        self.rows.update({k: n for k, n in vars(recording.rows).items() if n})
        for smooth in collector.tracks:
            own = collector.own_frames(smooth)
            self.tracks += collector.begins_here(smooth)
            self.states += own.stop - own.start
            raw, count = harsh_share(
                smooth.raw_x[own], smooth.raw_y[own], collector.rate
            )
            self.harsh_raw += raw
            smoothed = harsh_share(smooth.x[own], smooth.y[own], collector.rate)
            self.harsh_smooth += smoothed[0]
            self.accelerations += count
        self.flicker.update(collector.flicker)
        self.dropped.update(collector.dropped)
        self.shortened += collector.ended["shortened"]
        self.times += collector.ended["times"]
        self.times_cut += collector.ended["times_cut"]
        found = assumed(recording)
        self.assumed.update(found)
        self.assumed["lanes"] += len(recording.lanes)
        self.assumed["road users"] += len(recording.tracks)
        whose = {
            LIMIT: f"a speed limit of {recording.default_speed_limit:.2f} m/s",
            WIDTH: "the width of lanes",
            SIZE: "the size of road users",
        }
        words = ", ".join(whose[what] for what, count in found.items() if count)
        notes = [*recording.notes, *collector.signal_notes]
        notes += [note_of(collector.flicker)] if collector.flicker else []
        notes += [f"assumed where the log does not say it: {words}"] if words else []
        self.notes += [(recording.name, note) for note in notes]

    def add_scenes(self, demonstrations: Demonstration) -> None:
        """Count scenes, tags, decisions, headways, speeds and futures."""
        scene = demonstrations.scene
        count = int(np.shape(demonstrations.vehicle)[0])
        self.scenes += count
        for tag in Tag:
            self.tags[tag.name.lower()] += int(np.sum(scene.tags[:, tag]))
        known = np.asarray(scene.obstacles.kind) != Kind.NONE
        for decision in Decision:
            chosen = (np.asarray(demonstrations.decisions) == decision) & known
            self.decisions[decision.name.lower()] += int(np.sum(chosen))
        # time headway [s] to the followed car at the planning frame, if any
        speed = np.asarray(scene.ego.v)
        follows = np.asarray(demonstrations.decisions) == Decision.FOLLOW
        front = 0.5 * np.asarray(scene.ego.length)[:, None]
        gap = np.asarray(scene.obstacles.s_lower)[:, :, 0] - front
        usable = follows & (gap > 0.0) & (speed[:, None] > 2.0)
        headway = gap / np.maximum(speed, 1e-3)[:, None]
        headway = np.min(np.where(usable, headway, np.inf), axis=1)
        for counts, values, step in (
            (self.headways, headway[np.isfinite(headway)], HEADWAY_STEP_S),
            (self.speeds, speed, SPEED_STEP_MPS),
            (self.futures, np.asarray(demonstrations.future_s), FUTURE_STEP_S),
        ):
            counts.update(map(str, np.round(values / step).astype(int).tolist()))

    def state(self) -> dict:
        """Return all sums and lists, JSON-ready; `merge` takes it back."""
        return {
            name: dict(found) if isinstance(found, Counter) else found
            for name, found in vars(self).items()
        }

    def merge(self, state: dict) -> None:
        """Add another report's `state()`."""
        for name, found in state.items():
            mine = getattr(self, name)
            if isinstance(mine, Counter):
                mine.update(found)
            elif isinstance(mine, list):
                mine.extend(found)
            else:
                setattr(self, name, mine + found)

    def as_dict(self) -> dict:
        """JSON-ready summary."""
        total = max(self.accelerations, 1)
        values, times = _sorted(self.headways, HEADWAY_STEP_S)
        edges = (0.0, *HEADWAY_EDGES_S, np.inf)
        binned = np.histogram(values, edges, weights=times)[0]
        notes = merged_notes(self.notes)
        is_assumed = any(self.assumed[what] for what in (LIMIT, WIDTH, SIZE))
        return {
            "recordings": self.recordings,
            "tracks": self.tracks,
            "states": self.states,
            "scenes": self.scenes,
            "harsh_threshold_mps2": HARSH_MPS2,
            "harsh_share_raw": self.harsh_raw / total,
            "harsh_share_smoothed": self.harsh_smooth / total,
            "headway_s": _quantiles(self.headways, HEADWAY_STEP_S),
            "headway_histogram": {
                f"{low:g}-{high:g} s": int(count)
                for (low, high), count in zip(
                    itertools.pairwise(edges), binned, strict=True
                )
            },
            "speed_mps": _quantiles(self.speeds, SPEED_STEP_MPS),
            "future_s": _quantiles(self.futures, FUTURE_STEP_S),
            "shortened": self.shortened,
            "shortened_share": self.times_cut / max(self.times, 1),
            "tags": dict(self.tags),
            "decisions": dict(self.decisions),
            "dropped": {name: self.dropped.get(name, 0) for name in REASONS},
            # said only where it happened: the manifests of others keep their hash
            **({"rows": dict(self.rows)} if dropped_rows(self.rows) else {}),
            **({"flicker": dict(self.flicker)} if self.flicker else {}),
            **({"refused": self.refused} if self.refused else {}),
            **({"empty": self.empty} if self.empty else {}),
            **({"assumed": dict(self.assumed)} if is_assumed else {}),
            "notes": notes[:200],
            "num_notes": len(notes),
        }


def merged_notes(notes: Sequence[tuple[str, str]]) -> list[str]:
    """Returns notes as lines: equal ones of several recordings as one.

    What stands first among the notes of a recording comes first.

    Args:
      notes: (name of the recording, note), in the order of the recordings.
    """
    ranks: dict[str, int] = {}
    met: Counter = Counter()
    names: dict[str, list[str]] = {}
    for name, note in notes:
        ranks.setdefault(note, met[name])
        met[name] += 1
        names.setdefault(note, []).append(name)
    found = []
    for note in sorted(names, key=lambda note: ranks[note]):
        first, *more = dict.fromkeys(names[note])
        others = f" and {len(more)} more" if more else ""
        found.append(f"{first}{others}: {note}")
    return found


def assumed(recording: Recording) -> dict[str, int]:
    """Return how many lanes and road users of a recording go by a guess."""
    return {
        LIMIT: sum(lane.speed_limit is None for lane in recording.lanes),
        WIDTH: sum(lane.width_assumed for lane in recording.lanes),
        SIZE: sum(track.size_assumed for track in recording.tracks),
    }


def remedies(dropped: Mapping[str, int]) -> str:
    """Returns why scenes were dropped, most frequent first, with remedies."""
    counts = sorted(dropped.items(), key=lambda item: -item[1])
    return "; ".join(
        f"{count:,} {name}: try {REMEDIES[name]}" for name, count in counts if count
    )


def dropped_rows(rows: Mapping[str, int]) -> int:
    """Return rows of tables that were dropped."""
    return sum(count for why, count in rows.items() if why != "read")


def _sorted(counts: Counter, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Values in ascending order, and how often each was met."""
    pairs = sorted((int(key), count) for key, count in counts.items())
    keys, times = np.array(pairs, float).reshape(-1, 2).T
    return keys * step, times


def _quantiles(counts: Counter, step: float) -> dict | None:
    """5, 50 and 95 % points, to half a step; None of nothing."""
    if not counts:
        return None
    values, times = _sorted(counts, step)
    at = np.searchsorted(np.cumsum(times), np.array([0.05, 0.5, 0.95]) * times.sum())
    found = values[np.minimum(at, values.size - 1)]
    return dict(zip(("p05", "p50", "p95"), found.tolist(), strict=True))


def format_quality(report: dict) -> str:
    """Return the report as a terminal table."""
    lines = [
        f"{'recordings':<28}{report['recordings']:>10,}",
        f"{'tracks':<28}{report['tracks']:>10,}",
        f"{'states':<28}{report['states']:>10,}",
        f"{'scenes kept':<28}{report['scenes']:>10,}",
        f"{'|a| > 3 m/s^2, raw':<28}{report['harsh_share_raw']:>10.1%}",
        f"{'|a| > 3 m/s^2, smoothed':<28}{report['harsh_share_smoothed']:>10.1%}",
    ]
    for name, label in (
        ("speed_mps", "speed, m/s (5/50/95 %)"),
        ("headway_s", "headway, s (5/50/95 %)"),
        ("future_s", "future, s (5/50/95 %)"),
    ):
        if report[name] is not None:
            values = " / ".join(f"{value:.1f}" for value in report[name].values())
            lines.append(f"{label:<28}{values:>20}")
    if report["shortened"]:
        share = f"{report['shortened']:,} ({report['shortened_share']:.1%} of times)"
        lines.append(f"{'cut short by others':<28}{share:>20}")
    lines.append("")
    lines.append("tags                  scenes  share   dropped because")
    tags = sorted(report["tags"].items(), key=lambda item: -item[1])
    drops = sorted(report["dropped"].items(), key=lambda item: -item[1])
    for row in range(max(len(tags), len(drops))):
        left = " " * 35
        if row < len(tags):
            name, count = tags[row]
            left = f"{name:<19}{count:>9,}{count / max(report['scenes'], 1):>7.1%}"
        right = f"   {drops[row][0]:<24}{drops[row][1]:>9,}" if row < len(drops) else ""
        lines.append(left + right)
    decisions = ", ".join(f"{k} {v:,}" for k, v in report["decisions"].items())
    lines += ["", f"decisions per obstacle: {decisions}"]
    lines += oddities(report)
    if any(TOO_FEW in note for note in report["notes"]):
        lines.append(HOW_TO_POOL)
    return "\n".join(lines)


def oddities(report: Mapping) -> list[str]:
    """Return what was dropped, left out, skipped, guessed and noted."""
    lines = []
    if "flicker" in report:
        lines.append(note_of(report["flicker"]))
    if "rows" in report:
        rows = report["rows"]
        dropped = dropped_rows(rows)
        kinds = [f.name for f in dataclasses.fields(RowCounts) if rows.get(f.name)]
        why = ", ".join(f"{rows[kind]:,} {kind}" for kind in kinds if kind != "read")
        lines.append(
            f"rows dropped: {dropped:,} of {rows['read']:,} "
            f"({dropped / rows['read']:.2%}): {why}"
        )
    if report.get("refused"):
        lines.append(f"{counted(report['refused'], 'recording')} refused and left out")
    if report.get("empty"):
        skipped = counted(report["empty"], "recording")
        lines.append(f"{skipped} without traffic skipped")
    if report.get("assumed"):
        counts = report["assumed"]
        wholes = (LIMIT, "lanes"), (WIDTH, "lanes"), (SIZE, "road users")
        # a lane ends where it joins, splits or is cut: these are no whole lanes
        spoken = {"lanes": "pieces of lanes", "road users": "road users"}
        parts = [
            f"{what} of {counts[what]:,} of {counts[whole]:,} {spoken[whole]}"
            for what, whole in wholes
            if counts.get(what)
        ]
        files = report["recordings"]
        over = f", counted in each of {files:,} recordings" if files > 1 else ""
        lines.append(f"assumed, as the log does not say: {', '.join(parts)}{over}")
    lines += [f"note: {note}" for note in report["notes"][:NOTES_SHOWN]]
    if report["num_notes"] > NOTES_SHOWN:
        lines.append(f"{report['num_notes']} notes in all: manifest.json")
    return lines


def format_splits(dataset: Dataset) -> str:
    """Scenes and groups of each split, and by what it was split, in one line each."""
    flags, lines = dataset.manifest.import_flags, []
    for split in ("train", "test"):
        scenes = dataset.indices(split).size
        count = len(dataset.manifest.splits[split])
        lines.append(
            f"{'split ' + split:<28}{scenes:>10,} scenes "
            f"({scenes / max(dataset.count, 1):.1%}) in {counted(count, 'group')} of "
            "vehicles; no vehicle is in both splits"
        )
    if "split_by" in flags:
        asked = f"{flags['test_fraction']:.1%} of the scenes were asked for in test"
        lines.append(f"{'split by':<28}{flags['split_by']}; {asked}")
    return "\n".join(lines)
