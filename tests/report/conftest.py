"""Pages of a tuning run: whole, bare, and with markup in the data."""

import dataclasses

import pytest

from rcirl_jax.data.store.dataset import JoinedDatasets
from rcirl_jax.report import tuning_page
from rcirl_jax.report.replays import make_replays
from rcirl_jax.report.tuning_page import write_tuning_page
from tests.report.test_data_page import HOSTILE
from tests.report.tuning_case import PLAYED, cheap_rows, small_cases
from tests.report.tuning_case import small_report as build


@pytest.fixture(scope="session")
def replays():
    return make_replays(cheap_rows(), small_cases(), PLAYED, 1)


@pytest.fixture(scope="session")
def report(tmp_path_factory, replays):
    return build(tmp_path_factory.mktemp("inputs"), replays)


@pytest.fixture(scope="session")
def file(tmp_path_factory, report):
    folder = tmp_path_factory.mktemp("page")
    made = write_tuning_page(folder / "report.html", report)
    assert [path.name for path in folder.iterdir()] == ["report.html"]
    return made


@pytest.fixture(scope="session")
def page(file):
    return file.read_text()


def hostile(report):
    """The same report with markup in every name that comes from data."""
    change, suite = dataclasses.replace, report.suite
    rows = {HOSTILE if n == "hand-set" else n: row for n, row in suite.rows.items()}
    checks = tuple(
        change(check, title=check.title.replace("Queue with stop and go", HOSTILE))
        for check in report.verdict.checks
    )
    words = {"row": HOSTILE, "events": [(1.0, f"</script>{HOSTILE}")]}
    replays = [
        change(one, case=HOSTILE, parameters={HOSTILE: 1.0},
               drives=tuple(change(drive, **words) for drive in one.drives))
        for one in report.replays
    ]  # fmt: skip
    own = report.ranking.rows["candidate"]
    rank = report.ranking.human_rank_median["candidate"]
    return change(
        report,
        suite=change(suite, reference=HOSTILE, rows=rows),
        verdict=change(
            report.verdict, reasons=(HOSTILE,), look_at=(HOSTILE,), checks=checks
        ),
        incumbent=HOSTILE,
        replays=replays,
        rewards={HOSTILE: report.rewards["candidate"]},
        facts={HOSTILE: {"name": f"</script>{HOSTILE}"}},
        ranking=change(
            report.ranking,
            rows={HOSTILE: own},
            runs={HOSTILE: 1},
            human_rank_median={HOSTILE: rank},
        ),
    )


def drawn(report, folder):
    """Its page, without frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning_page, "draw_frames", lambda *_: [])
        return write_tuning_page(folder / "report.html", report)


@pytest.fixture(scope="session")
def hostile_file(report, tmp_path_factory):
    return drawn(hostile(report), tmp_path_factory.mktemp("hostile"))


@pytest.fixture(scope="session")
def bare_file(report, tmp_path_factory):
    """No sweep, no replay, no run, and an incumbent that is not learned."""
    bare = dataclasses.replace(
        report,
        sweep=None,
        replays=[],
        workdir=None,
        rewards={"candidate": report.rewards["candidate"]},
        dataset=JoinedDatasets([report.dataset]),
        verdict=dataclasses.replace(
            report.verdict, decision="could not judge", look_at=()
        ),
    )
    return drawn(bare, tmp_path_factory.mktemp("bare"))
