"""What a reward wants, feature by feature: response curves and shares."""

from collections.abc import Mapping, Sequence

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.statistics import Difference
from rcirl_jax.export.loading import prior_cost_words
from rcirl_jax.export.reader import Reward
from rcirl_jax.report.pages import Table, interval, part
from rcirl_jax.report.tuning.contributions import Contributions, contributions
from rcirl_jax.report.tuning.curves import response_curves


def features_view(
    dataset: Demonstrations, rewards: Mapping[str, Reward], incumbent: str
) -> dict:
    """Curves, shares, and what has no effect.

    Args:
      dataset: its held-out scenes.
      rewards: by name.
      incumbent: named where it is no weights file.
    """
    found = contributions(dataset, rewards)
    notes = []
    for name, reward in rewards.items():
        if reward.unsupported:
            notes.append(
                f"Without effect in the {name}, because they never vary in its "
                f"training data: {', '.join(reward.unsupported)}."
            )
        if said := prior_cost_words(name, reward):
            notes.append(f"{said} The curves show V.")
    if len(rewards) == 1:
        notes.append(
            f"The incumbent, {incumbent}, is no weights file: it has neither gamma nor "
            "these features, so only the drives show what changed."
        )
    silent = [row.feature for row in found.rows if not _counts(row.share)]
    return {
        "notes": notes,
        "curves": response_curves(rewards, found),
        "table": _shares(found, list(rewards)),
        "silent": ", ".join(silent),
    }


def _counts(share: Mapping) -> bool:
    return any(one and one.high > 0.0 for one in share.values())


def _shares(found: Contributions, names: Sequence[str]) -> Table:
    """Mean absolute contribution to the value difference of human and candidates."""
    heads = ["feature", *names]
    if len(names) > 1:
        heads += [f"{names[0]} minus {names[1]}, points", ""]
    rows = []
    for row in found.rows:
        if not _counts(row.share):
            continue
        cells: list[object] = [row.feature]
        for name in names:
            one = row.share[name]
            cells.append(
                "not a feature of it"
                if one is None
                else interval((one.value, one.low, one.high), 1, 100.0) + " %"
            )
        if len(names) > 1:
            cells += _changed(row.difference)
        share = row.share[names[0]]
        rows.append([*cells, part("bar", 0.0 if share is None else share.value)])
    caption = (
        "Share of each feature in the value difference between the human and "
        f"candidates (integrated gradients), {found.scenes} held-out scenes of "
        f"{found.vehicles} vehicles; 95 % intervals over vehicles"
    )
    return Table(caption=caption, heads=[*heads, ""], rows=rows, kind="bars")


def _changed(found: Difference | None) -> list[object]:
    if found is None:
        return ["", ""]
    word = "no difference"
    if not found.low <= 0.0 <= found.high:
        word = "counts more" if found.mean > 0.0 else "counts less"
    values = (found.mean, found.low, found.high)
    return [interval(values, 1, 100.0, signed=True), word]
