"""The page of a tuning run: true to the reports, safe, complete in one file."""

import base64
import dataclasses
import hashlib
import html
import json
import re

import jax
import numpy as np
import pytest

from rcirl_jax.evaluation.closed_loop.summary import PAPER, comfort_cells, summarise
from rcirl_jax.evaluation.gate.types import Check
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.report.features import NUM_CANDIDATES, contributions
from rcirl_jax.report.frames import _sampled
from rcirl_jax.report.pages import interval
from rcirl_jax.report.player import case_lines
from rcirl_jax.report.replays import _broken_words, goes_as
from rcirl_jax.report.tuning_page import cards, outcome_of
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation.metrics import COLUMNS
from tests.report.test_data_page import HOSTILE, Page, assert_it_needs_no_other
from tests.report.tuning_case import PLAYED, WARNINGS

MAX_BYTES = 3e6


def section(page, anchor):
    (found,) = re.findall(rf'<section id="{anchor}".*?</section>', page, re.DOTALL)
    return found


def rows(page, anchor):
    """First cell -> the other cells of all rows of a section with that first cell."""
    found = {}
    for first, *others in filter(None, Page(section(page, anchor)).rows):
        found.setdefault(first, []).append(others)
    return found


def forest_rows(page):
    """Those of the checks, without the table of margins."""
    found = rows(page, "checks").items()
    return {name: [row for row in cells if len(row) == 4] for name, cells in found}


def number(cell):
    return float(re.match(r"[+−]?[\d.]+", cell)[0].replace("−", "-"))


def player_data(page):
    (body,) = re.findall(r'id="replays">(.*?)</script>', page)
    return json.loads(body)


def test_it_is_one_small_file_that_needs_no_other_and_runs_its_own_script(file, page):
    assert file.stat().st_size < MAX_BYTES
    assert_it_needs_no_other(page)
    (policy,) = re.findall(r'Security-Policy" content="([^"]*)"', page)
    policy = html.unescape(policy)
    assert "default-src 'none'" in policy
    (code,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy


def test_warnings_are_at_the_top_of_their_sections(page):
    for anchor, (said,) in WARNINGS.items():
        found = section(page, anchor)
        assert found.index(said) < found.index("<figure>")
        assert f'<a href="#{anchor}">' in section(page, "verdict")
    assert page.count("<strong>Warning:</strong>") == len(WARNINGS)


def test_text_from_data_stays_text(hostile_file):
    text = hostile_file.read_text()
    assert HOSTILE not in text
    assert text.count("&lt;script&gt;alert(1)") > 10
    found = Page(text)
    assert len(found.of("script")) == 2  # the data and the player
    assert all("onerror" not in attrs for _, attrs in found.tags)
    assert player_data(text)["cases"][0]["case"] == HOSTILE


def test_the_verdict_comes_first(page, report):
    text = section(page, "verdict")
    assert report.verdict.decision == "do not ship"
    for reason in report.verdict.reasons:
        assert f"<li>{reason}</li>" in text
    for place, case in enumerate(PLAYED):
        link = f'<a href="#player" data-case="{place}">{case}</a>'
        assert link in section(page, "cases")
    assert report.likeness in section(page, "likeness")


def test_cases_are_those_of_the_suite_the_played_and_the_worst_first(page, report):
    shown = [row for row in Page(section(page, "cases")).rows if len(row) == 7][1:]
    assert [row[0] for row in shown[:2]] == list(PLAYED)
    assert {row[0] for row in shown} == set(report.suite.ids)
    mine, theirs = (report.suite.rows[name] for name in ("candidate", "hand-set"))
    for row in shown:
        at = report.suite.ids.index(row[0])
        assert ("at-fault collision" in row[2]) == (mine.at_fault[at] > 0)
        ahead = mine.progress[at] - theirs.progress[at]
        assert number(row[4]) == pytest.approx(ahead, abs=0.51)
    worst = [row[2] == "at-fault collision" for row in shown[2:]]
    assert worst == sorted(worst, reverse=True)
    assert section(page, "cases").count('class="thumbnail"') == len(PLAYED)


def test_a_drive_that_goes_otherwise_than_in_the_suite_is_named(report):
    def otherwise(words):
        drives = [
            dataclasses.replace(drive, summary=drive.summary + words)
            for drive in report.replays[0].drives
        ]
        replay = dataclasses.replace(report.replays[0], drives=tuple(drives))
        lines = case_lines(report.suite, report.incumbent, [replay])
        return [line.case for line in lines if line.otherwise]

    assert otherwise(", never seen") == [report.replays[0].case]
    metrics = jax.tree.map(lambda x: np.asarray(x)[0], report.suite.rows["hand-set"])
    drive = report.replays[0].drives[0]
    summary = f"9 m driven, nobody near, {_broken_words(metrics)}"
    assert goes_as(dataclasses.replace(drive, summary=summary), metrics)


def test_the_cards_say_what_the_checks_say(page, report):
    text = section(page, "verdict")
    text = re.sub(r"</?abbr.*?>", "", text)
    found = dict(re.findall(r"<h3>(.*?)</h3><b>(.*?)</b>", text))
    assert list(found) == [
        "Cases driven", "Nearer to the human", "Safety", "Comfort", "Progress",
    ]  # fmt: skip
    assert found["Cases driven"] == f"{report.verdict.cases:,}"
    assert found["Safety"] == "12 / 0"
    assert 'class="card refused"><h3>Safety' in text
    gains = {c.name: c for c in report.verdict.checks if c.kind == "gain"}
    comfort = [number(x) for x in found["Comfort"].split(" / ")]
    wanted = [100.0 * gains[name].difference for name in ("rms_a", "rms_j")]
    assert comfort == pytest.approx(wanted, abs=0.051)
    progress = 100.0 * gains["progress"].difference
    assert number(found["Progress"]) == pytest.approx(progress, abs=0.051)


def test_every_check_is_there_with_its_interval(page, report):
    found, families = forest_rows(page), rows(page, "families")
    for check in report.verdict.checks:
        if check.kind == "families":
            cells = families[check.title.rpartition(": ")[0]]
        else:
            cells = found[check.title]
        if not check.measured:
            assert "not measured" in [row[1] for row in cells]
            continue
        values = (check.difference, check.low, check.high)
        words = interval(values, 2, scale=100.0, signed=True) + " %"
        assert number(words) == pytest.approx(100.0 * check.difference, abs=0.005)
        assert words in [row[1] for row in cells], check.name
        if check.outcome == "fail":
            assert "FAIL" in [row[3] for row in cells]


def test_safety_that_is_not_shown_is_no_green_card(report):
    suite, kinds = summarise(report.suite), {}
    for outcome in ("pass", "open", "fail"):
        checks = tuple(
            dataclasses.replace(one, outcome=outcome) if one.name == "red_light" else
            dataclasses.replace(one, outcome="pass")
            for one in report.verdict.checks
        )  # fmt: skip
        verdict = dataclasses.replace(report.verdict, checks=checks)
        kinds[outcome] = cards(verdict, suite, "hand-set")[2]["kind"]
    assert kinds == {"pass": "ship", "open": "open", "fail": "refused"}


@pytest.mark.parametrize(("outcome", "kind"), [("pass", "ship"), ("open", "open")])
def test_a_gain_that_the_verdict_does_not_call_one_is_no_green_card(
    report, outcome, kind
):
    """Holm's correction may refuse what an interval above 0 suggests."""
    gain = Check(
        kind="gain", name="likeness", title="", outcome=outcome, difference=0.3,
        low=0.06, high=0.53, margin=None, gained=None, lost=None, p=0.057,
    )  # fmt: skip
    verdict = dataclasses.replace(report.verdict, checks=(gain,))
    card = cards(verdict, summarise(report.suite), "hand-set")[1]
    assert card["kind"] == kind
    assert ("not certain" in card["words"]) == (outcome == "open")


def test_a_loss_is_never_called_no_difference(report):
    (check, *_) = [check for check in report.verdict.checks if check.kind == "gain"]
    for p, word in ((0.004, "worse"), (0.2, "no difference")):
        seen = dataclasses.replace(check, difference=-0.02, p=p, outcome="open")
        assert outcome_of(seen) == (word, "open")


def test_the_papers_table_is_the_suites(page, report):
    found = rows(page, "suite")
    suite = summarise(report.suite)
    for name, row in suite.rows.items():
        for place, kind in enumerate(("per_case", "per_sample")):
            for cell, column in zip(found[name][place], COLUMNS, strict=True):
                rate = getattr(row, kind)[column]
                assert number(cell) == pytest.approx(100.0 * rate.k / rate.n, abs=0.005)
                ends = [float(x) for x in re.findall(r"[\d.]+", cell)][1:]
                if rate.k == rate.n:
                    assert 97.0 < ends[0] < 100.0
                else:
                    wanted = [100.0 * rate.low, 100.0 * rate.high]
                    assert ends == pytest.approx(wanted, abs=0.05)
    for name, values in PAPER.items():
        assert found[name] == [[f"{value:.2f}" for value in values]] * 2
    comfort, safety = found["candidate"][2:4]
    assert comfort == comfort_cells(suite.rows["candidate"])
    physical = suite.rows["candidate"].physical
    assert float(comfort[0]) == pytest.approx(physical["rms_a"], abs=0.005)
    assert safety[:4] == ["12", "0", "0", "12"]
    assert f"{suite.rows['candidate'].at_fault}" == "12"


def test_a_linear_rewards_shares_are_its_terms(report):
    """gamma_t w_i (x_ti - y_ti), summed over time, from the drawn frame's features."""
    reward = report.rewards["candidate"]
    weight = np.random.default_rng(1).normal(size=(len(reward.names), 1))
    linear = dataclasses.replace(
        reward,
        kernels=(weight.astype(np.float32),),
        biases=(np.zeros(1, np.float32),),
        activation="identity",
    )
    found = contributions(report.dataset, {"linear": linear})
    index = report.dataset.indices("test")
    assert index.size == found.scenes
    shares = []
    for row in index:
        one = jax.tree.map(lambda x: x[0], report.dataset.read(np.array([row])))
        program = _sampled(reward.preset, SamplerConfig(), None)
        candidates, _, both, _ = program(candidates_key(row), one, None)
        x, mine = both[:-1], both[-1]
        feasible = np.flatnonzero(candidates.feasible)
        at = (np.arange(NUM_CANDIDATES) + 0.5) * feasible.size / NUM_CANDIDATES
        taken = np.asarray(x)[feasible[at.astype(int)]]
        clip = lambda x: np.clip(x, linear.lower, linear.upper) / linear.scale  # noqa: E731
        gamma = np.where(one.scene.time_valid, linear.gamma, 0.0)
        terms = np.einsum("t,ktf->kf", gamma, clip(np.asarray(mine)) - clip(taken))
        sizes = np.abs(terms * weight[:, 0]).mean(axis=0)
        shares.append(sizes / sizes.sum())
    wanted = dict(zip(reward.names, np.mean(shares, axis=0), strict=True))
    for row in found.rows:
        assert row.share["linear"].value == pytest.approx(
            wanted[row.feature], abs=2e-4
        ), row.feature
