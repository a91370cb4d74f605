"""How often would the guard of a weights file speak up on recorded scenes?

    python -m experiments.guard_rate --weights=FILE --data=DATASET

On held-out scenes of the site that the reward was trained on these are false alarms;
on another site, in part, what the guard is for. docs/guard.md has the rule. Prints
the share of the scenes whose plan is out of distribution, by which feature, and the
features to which the guard is blind.
"""

from absl import flags

from experiments.common import run
from rcirl_jax.data.store.joined import open_datasets
from rcirl_jax.export.guard import Guard, Limits
from rcirl_jax.export.guard_rate import guard_rate
from rcirl_jax.export.loading import open_reward

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file", required=True)
_DATA = flags.DEFINE_list("data", None, "datasets of import_logs", required=True)
_SPLIT = flags.DEFINE_string("split", "test", "split that is looked at")
_MARGIN = flags.DEFINE_float(
    "margin", 0.25, "scales by which recorded ranges are widened", lower_bound=0.0
)
_REACH = flags.DEFINE_float(
    "reach", 3.0, "scales around the location, without recorded ranges", lower_bound=0.0
)
_SHARE = flags.DEFINE_float(
    "share", 0.25, "largest share of a feature's entries outside", 0.0, 1.0
)


def main() -> None:
    """Flags -> one rate."""
    limits = Limits(margin=_MARGIN.value, reach=_REACH.value, share=_SHARE.value)
    reward = open_reward(_WEIGHTS.value)
    rate = guard_rate(reward, open_datasets(_DATA.value), _SPLIT.value, limits)
    kind = "the normaliser" if reward.seen is None else "recorded ranges"
    total, flagged = len(rate.verdicts), rate.flagged
    print(
        f"{len(flagged)} of {total} plans out of distribution by {kind} "
        f"({len(flagged) / max(total, 1):.1%})"
    )
    for name, count in rate.by_feature.items():
        print(f"  {name}: {count}")
    blind = ", ".join(Guard(reward, limits).blind) or "none"
    print(f"blind to (both sides of the range open): {blind}")
    if flagged:
        print(f"dataset rows, the worst first: {', '.join(map(str, flagged[:10]))}")


if __name__ == "__main__":
    run(main)
