"""The page of a tuning run: true to the reports, safe, complete in one file."""

import base64
import dataclasses
import hashlib
import json
import re
import shutil

import jax
import numpy as np
import pytest

from rcirl_jax.data.store.joined import JoinedDatasets
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.summary import PAPER
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.report.markup import interval
from rcirl_jax.report.player.replays import AHEAD_M, BEHIND_M, FRAME_STEPS, make_replays
from rcirl_jax.report.ranking.frames import _sampled
from rcirl_jax.report.tuning import page as tuning_page
from rcirl_jax.report.tuning.contributions import NUM_CANDIDATES, contributions
from rcirl_jax.report.tuning.page import write_tuning_page
from rcirl_jax.report.tuning.verdict_sections import outcome_of
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.simulation import rollout
from rcirl_jax.simulation import suite as suite_module
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.metrics import COLUMNS
from rcirl_jax.simulation.recorded.config import RecordedConfig
from rcirl_jax.simulation.rollout import LANES, drive_cases
from rcirl_jax.simulation.suite import (
    catalogue_set,
    drive_row,
    drive_with_logs,
    recorded_set,
    rollout_config,
    suite_refs,
)
from rcirl_jax.units import TIMES_S
from tests.helpers.weights_files import example_anchor
from tests.report.test_data_page import HOSTILE, Page
from tests.report.tuning_case import PLAYED, SECONDS, cheap_rows, small_cases
from tests.report.tuning_case import small_report as build
from tests.simulation.test_recorded import traffic

MAX_BYTES = 3e6
ANCHORS = re.compile(r'<section id="(\w+)"')


@pytest.fixture(scope="module")
def replays():
    return make_replays(cheap_rows(), small_cases(), PLAYED, 1)


@pytest.fixture(scope="module")
def report(tmp_path_factory, replays):
    return build(tmp_path_factory.mktemp("inputs"), replays)


@pytest.fixture(scope="module")
def file(tmp_path_factory, report):
    folder = tmp_path_factory.mktemp("page")
    made = write_tuning_page(folder / "report.html", report)
    assert [path.name for path in folder.iterdir()] == ["report.html"]
    return made


@pytest.fixture(scope="module")
def page(file):
    return file.read_text()


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
    """Those of the verdict, without the table of margins."""
    found = rows(page, "verdict").items()
    return {name: [row for row in cells if len(row) == 4] for name, cells in found}


def number(cell):
    return float(re.match(r"[+−]?[\d.]+", cell)[0].replace("−", "-"))


def player_data(page):
    (body,) = re.findall(r'id="replays">(.*?)</script>', page)
    return json.loads(body)


# ----------------------------------------------------------------- one safe file


def test_it_is_one_small_file_that_needs_no_other_and_runs_its_own_script(file, page):
    assert file.stat().st_size < MAX_BYTES
    found = Page(page)
    assert not found.of("link")
    for tag, attrs in found.tags:
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            value = attrs.get(name) or "#"
            assert value.startswith(("#", "data:image/png;base64,")), (tag, name)
    assert not re.search(r"url\(|@import|\beval\(|new Function|fetch\(|XMLHttp", page)
    (policy,) = re.findall(r'Security-Policy" content="([^"]*)"', page)
    assert "default-src 'none'" in policy
    (code,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy


def test_sections_come_in_order_and_are_linked(page):
    anchors = ANCHORS.findall(page)
    assert anchors[:4] == ["verdict", "suite", "families", "worst"]
    assert anchors[-3:] == ["data", "sweep", "provenance"]
    links = [a["href"] for a in Page(page).of("a") if a["href"] != "#player"]
    assert links == [f"#{anchor}" for anchor in anchors]
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def hostile(report):
    """The same report with markup in every name that comes from data."""
    change, suite = dataclasses.replace, report.suite
    rows = {HOSTILE if n == "hand-set" else n: row for n, row in suite.rows.items()}
    checks = tuple(
        change(check, name=check.name.replace("stop_and_go", HOSTILE))
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


@pytest.fixture(scope="module")
def hostile_file(report, tmp_path_factory):
    return drawn(hostile(report), tmp_path_factory.mktemp("hostile"))


def test_text_from_data_stays_text(hostile_file):
    text = hostile_file.read_text()
    assert HOSTILE not in text
    assert text.count("&lt;script&gt;alert(1)") > 10
    found = Page(text)
    assert len(found.of("script")) == 2  # the data and the player
    assert all("onerror" not in attrs for _, attrs in found.tags)
    assert player_data(text)["cases"][0]["case"] == HOSTILE


@pytest.fixture(scope="module")
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


def test_what_there_is_not_is_left_out(bare_file):
    text = bare_file.read_text()
    assert {"verdict", "sweep", "worst", "data"} <= set(ANCHORS.findall(text))
    assert "training" not in ANCHORS.findall(text)
    assert section(text, "gamma").count("<polyline") == 1
    assert "<img" not in section(text, "sweep")


# -------------------------------------------------------------- numbers it prints


def test_the_verdict_comes_first(page, report):
    text = section(page, "verdict")
    assert report.verdict.decision == "do not ship"
    for reason in report.verdict.reasons:
        assert f"<li>{reason}</li>" in text
    for place, case in enumerate(PLAYED):
        assert f'<a href="#player" data-case="{place}">{case}</a>' in text
    assert report.likeness in section(page, "likeness")


def test_every_check_is_there_with_its_interval(page, report):
    found = forest_rows(page)
    families = rows(page, "families")
    for check in report.verdict.checks:
        if check.kind == "families":
            cells = families[check.name.split(",")[0]]
        else:
            cells = found[check.name.replace("_", " ")]
        values = (check.difference, check.low, check.high)
        words = interval(values, 2, scale=100.0, signed=True) + " %"
        assert number(words) == pytest.approx(100.0 * check.difference, abs=0.005)
        assert words in [row[1] for row in cells], check.name
        if check.outcome == "fail":
            assert "FAIL" in [row[3] for row in cells]
    marked = re.findall(r'<tr class="marked"><th scope="row">([^<]*)', page)
    failed = [c for c in report.verdict.checks if c.outcome == "fail"]
    names = {check.name.split(",")[0].replace("_", " ") for check in failed}
    assert names <= {name.replace("_", " ") for name in marked}
    rects = section(page, "families").count('<rect class="failed"')
    assert rects == sum(check.kind == "families" for check in failed)


def test_a_loss_is_never_called_no_difference(report):
    (check, *_) = [check for check in report.verdict.checks if check.kind == "gain"]
    for difference, p, word in ((-0.02, 0.004, "worse"), (-0.02, 0.2, "no difference")):
        seen = dataclasses.replace(check, difference=difference, p=p, outcome="open")
        assert outcome_of(seen) == (word, "open")


def test_the_papers_table_is_the_suites(page, report):
    found = rows(page, "suite")
    for name, row in report.suite.rows.items():
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
    assert found["candidate"][2][:4] == ["12", "0", "0", "12"]
    assert f"{report.suite.rows['candidate'].at_fault}" == "12"


def test_ranking_data_sweep_provenance_and_gamma_are_the_reports(page, report):
    cells = rows(page, "ranking")["candidate"][0]
    estimate = report.ranking.rows["candidate"]["top1_fde"]
    assert cells[2] == f"{estimate.value:.2f} [{estimate.low:.2f}, {estimate.high:.2f}]"
    quality = report.dataset.manifest.quality
    assert re.search(rf" {quality['scenes']}\b", section(page, "data"))
    sweep = section(page, "sweep")
    assert re.search(r"0\.05 +0\.001 +1\.500 m", sweep)
    assert "data:image/png" in sweep
    origin = section(page, "provenance")
    for hashed in (report.dataset, *report.rewards.values()):
        assert getattr(hashed, "sha256", report.dataset.hash) in origin
    for line in ("&quot;seed&quot;: 3", "&quot;train&quot;: &quot;12ef&quot;"):
        assert line in origin
    table = rows(page, "gamma")
    for place, reward in enumerate(report.rewards.values()):
        gamma = reward.gamma * np.sign(reward.gamma.sum())
        shown = [number(table[f"{t:.2f}"][0][place]) for t in TIMES_S]
        assert shown == pytest.approx(gamma / np.abs(gamma).max(), abs=6e-4)
    assert section(page, "gamma").count("<polyline") == 2


def test_feature_shares_are_those_of_the_contributions(page, report):
    found = contributions(report.dataset, report.rewards)
    for name in report.rewards:
        assert sum(row.share[name].value for row in found.rows) == pytest.approx(1.0)
    table = rows(page, "features")
    for row in found.rows:
        if row.share["candidate"].high > 0.0:
            cells = table[row.feature][0]
            mine, theirs = (row.share[name].value for name in report.rewards)
            for cell, share in zip(cells, (mine, theirs, mine - theirs), strict=False):
                assert number(cell) == pytest.approx(100.0 * share, abs=0.05)
            silent = row.difference.low <= 0.0 <= row.difference.high
            assert (cells[3] == "no difference") == silent
    assert len({row.difference.mean > 0.0 for row in found.rows}) == 2


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
        candidates, _, x, mine = _sampled(reward.preset, SamplerConfig())(
            candidates_key(row), one
        )
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


def test_features_without_effect_and_gains_are_said(report):
    reward = report.rewards["candidate"]
    lower = reward.lower.copy()
    lower[1] = reward.upper[1]
    anchor = example_anchor(features=len(reward.names))
    anchor = dataclasses.replace(anchor, low=0.26, high=1.57)
    anchored = dataclasses.replace(reward, lower=lower, anchor=anchor)
    both = {**report.rewards, "candidate": anchored}
    text = tuning_page._features(dataclasses.replace(report, rewards=both))
    (said,) = re.findall(r"<p>([^<]*is anchored[^<]*)</p>", text)
    assert "0.26" in said
    assert "1.57" in said
    assert f": {reward.names[1]}." in text


# ------------------------------------------------------------------------- drives


def driven(row, cases, count):
    """Record and snapshots of the first cases, as the replays drive them."""
    at = np.minimum(np.arange(LANES), count - 1)
    full = jax.tree.map(lambda x: np.asarray(x)[at], cases.build(0, count))
    config = rollout_config(row, cases.duration_s, 1)
    config = dataclasses.replace(config, snapshots=True)
    logs = drive_cases(row.policy, row.params, full, config)
    return jax.tree.map(np.asarray, logs[0]), jax.tree.map(np.asarray, logs[1])


def test_frames_are_the_drives_own(replays):
    cases = small_cases()
    assert [one.case for one in replays] == list(PLAYED)
    for place, row in enumerate(cheap_rows()):
        record, shot = driven(row, cases, 2)
        for one in replays:
            number, drive = cases.ids.index(one.case), one.drives[place]
            assert drive.row == row.name
            last = int(record.valid[number].sum()) - 1
            steps = np.arange(FRAME_STEPS - 1, last + FRAME_STEPS, FRAME_STEPS)
            steps = np.minimum(steps, last)
            assert len(drive.s) == steps.size
            driven_m = record.s[number, : last + 1].max()
            assert drive.summary.startswith(f"{driven_m:.0f} m driven, ")
            hit = bool(record.at_fault[number, : last + 1].any())
            assert ("fails collision free" in drive.summary) == hit
            for name, half in (("s", 0.051), ("l", 0.0051), ("v", 0.051)):
                shown = getattr(drive, name)
                wanted = getattr(record, name)[number, steps]
                assert shown == pytest.approx(wanted, abs=half)
            for frame, step in zip(drive.agents, steps, strict=True):
                slots = dict(zip(frame[::4], frame[1::4], strict=True))
                s = shot.agents.s[number, step]
                ahead = s - record.s[number, step]
                near = (ahead > -BEHIND_M) & (ahead < AHEAD_M)
                there = shot.agents.present[number, step] & near
                assert set(np.flatnonzero(there)) <= set(slots)
                for slot, station in slots.items():
                    assert station == pytest.approx(s[int(slot)], abs=0.051)
            assert {int(a) for f in drive.agents for a in f[::4]} <= set(one.bodies)


def test_the_drives_are_those_of_the_suite():
    """To the bit, and without another program: what the table says is what plays."""
    cases, row = small_cases(), cheap_rows()[0]
    config = rollout_config(row, cases.duration_s, 1)
    suite = drive_row(row, cases.build, len(cases.ids), config, chunk=60)
    kept = dataclasses.replace(config, snapshots=True)
    program = rollout._compiled(row.policy, suite_module._reduced, kept, None, True)
    assert program._cache_size() == 1
    at = cases.ids.index(PLAYED[0])
    found, record, shot = drive_with_logs(row, cases.build(at, at + 1), config)
    assert program._cache_size() == 1
    for mine, theirs in zip(
        jax.tree.leaves(found), jax.tree.leaves(suite), strict=True
    ):
        np.testing.assert_array_equal(mine[0], theirs[at])
    assert record.s.shape == (1, config.steps)
    assert shot.plan_s.shape[:2] == (1, config.steps)


def test_a_crash_ends_the_drive_and_shows_who_was_hit(replays):
    crashed, fine = replays[0].drives
    assert "collision of its own fault" in crashed.end
    assert crashed.events[0][1] == "collision of its own fault"
    when = crashed.events[0][0]
    assert when < SECONDS - 0.3
    assert len(crashed.s) == int(np.ceil(when / STEP_S / FRAME_STEPS - 1e-6))
    assert crashed.start == when
    ahead = [station - crashed.s[-1] for station in crashed.agents[-1][1::4]]
    assert min(abs(gap) for gap in ahead) < 6.0  # two half lengths and a bit
    assert crashed.clearance[-1] <= 0.0
    assert not fine.end
    assert len(fine.s) == round(SECONDS / STEP_S / FRAME_STEPS)
    # at constant speed the plan k seconds ahead is k times the speed
    drive = replays[1].drives[0]
    for plan, speed in zip(drive.plan, drive.v, strict=True):
        assert plan == pytest.approx([k * speed for k in (1, 2, 3, 4, 5)], abs=0.4)


@pytest.mark.slow
def test_a_red_light_is_among_what_failed():
    refs = suite_refs("red_light", 1)
    (one,) = make_replays(cheap_rows()[:1], catalogue_set(refs, 10.0), [refs[0].id], 1)
    (drive,) = one.drives
    assert [what for _, what in drive.events] == ["red light run"]
    assert drive.summary.endswith("fails red lights")
    assert any(drive.red)
    at = round(drive.start / one.frame_s) - 1
    assert one.lines[drive.red[at][0]] - drive.s[at] < 4.0  # its front is at the line


def test_a_case_that_the_suite_does_not_have():
    with pytest.raises(InputError, match="cut_in/007@0: expected a case"):
        make_replays(cheap_rows(), small_cases(), ["cut_in/007@0"], 1)
    assert make_replays(cheap_rows(), small_cases(), [], 1) == []


@pytest.mark.slow
def test_the_recorded_human_drives_beside_the_others(tmp_path):
    config = RecordedConfig(max_duration_s=6.0, max_cases=1, smoothing_s=0.0, steps=60)
    cases = recorded_set([traffic(tmp_path, "urban_turn_left")], config)
    (one,) = make_replays(cheap_rows(), cases, cases.ids, 1)
    assert [drive.row for drive in one.drives] == [
        "candidate", "hand-set", "recorded human",
    ]  # fmt: skip
    human, log = one.drives[-1], np.asarray(cases.build(0, 1).replay.ego_s[0])
    at = FRAME_STEPS * (np.arange(len(human.s)) + 1)
    assert human.s == pytest.approx(log[np.minimum(at, len(log) - 1)], abs=0.06)
    assert not any(human.plan)


# ------------------------------------------------------------------------ browser


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium, or a skip with the reason."""
    playwright = pytest.importorskip("playwright.sync_api")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no Chromium found: install chromium")
    with playwright.sync_playwright() as driver:
        made = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield made
        made.close()


def opened(browser, file, width=1280, height=900, **options):
    """A page, and the list into which complaints and foreign requests go."""
    view = browser.new_page(viewport={"width": width, "height": height}, **options)
    wrong = []
    view.on("console", lambda message: wrong.append(message.text))
    view.on("pageerror", lambda error: wrong.append(str(error)))
    view.on("dialog", lambda dialog: (wrong.append(dialog.message), dialog.dismiss()))
    foreign = lambda url: None if url[:5] in ("file:", "data:") else wrong.append(url)  # noqa: E731
    view.on("request", lambda request: foreign(request.url))
    view.goto(file.as_uri())
    return view, wrong


COLOURS = """canvas => {
  const pen = canvas.getContext("2d");
  const data = pen.getImageData(0, 0, canvas.width, canvas.height).data;
  const found = new Set();
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] === 255) found.add(data.slice(i, i + 3).join());
  }
  return [...found];
}"""


def clock(view):
    return float(re.search(r": ([\d.]+) s of", view.inner_text("#clock"))[1])


@pytest.mark.browser
def test_it_opens_without_complaint_and_draws(browser, file):
    view, wrong = opened(browser, file)
    canvases = view.query_selector_all(".views canvas")
    assert len(canvases) == 4
    for number, canvas in enumerate(canvases):
        colours = canvas.evaluate(COLOURS)
        own = "213,94,0" if number < 2 else "0,114,178"
        assert own in colours
        assert len(colours) > 5
        row = "candidate" if number < 2 else "hand-set"
        assert f"of {row}" in canvas.get_attribute("aria-label")
    broken = view.eval_on_selector_all("img", "all => all.filter(x => !x.naturalWidth)")
    assert broken == []
    assert wrong == []
    view.close()


@pytest.mark.browser
def test_play_and_keys_move_the_player(browser, file):
    view, wrong = opened(browser, file)
    view.focus("#player")
    view.keyboard.press("Home")
    first = clock(view)
    before = view.locator(".views canvas").first.evaluate("c => c.toDataURL()")
    view.click("#play")
    for _ in range(100):  # the page's policy forbids Playwright's own waiting
        view.wait_for_timeout(100)
        if clock(view) > 1.0:
            break
    assert clock(view) > 1.0
    view.keyboard.press("Space")
    assert view.locator(".views canvas").first.evaluate("c => c.toDataURL()") != before
    view.focus("#scrub")
    view.keyboard.press("Home")
    assert clock(view) == first == pytest.approx(0.2)
    for key, wanted in (
        ("ArrowRight", 0.4), ("ArrowRight", 0.6), ("ArrowLeft", 0.4), ("End", SECONDS),
    ):  # fmt: skip
        view.keyboard.press(key)
        assert clock(view) == pytest.approx(wanted)
    view.click("#back")
    assert clock(view) == pytest.approx(SECONDS - 0.2)
    assert "collision of its own fault." in view.inner_text(".drive >> nth=0")
    view.click("#events button >> nth=0")
    assert clock(view) < SECONDS - 0.3
    view.select_option("#case", "1")
    assert PLAYED[1] in view.inner_text("#clock")
    view.click("a[data-case='0']")
    assert PLAYED[0] in view.inner_text("#clock")
    assert view.evaluate("document.activeElement.id") == "player"
    assert wrong == []
    view.close()


@pytest.mark.browser
def test_a_phone_needs_no_sideways_scroll(browser, file, bare_file):
    for shown in (file, bare_file):
        view, wrong = opened(browser, shown, width=390, height=844)
        assert view.evaluate("document.documentElement.scrollWidth") <= 390
        outside = view.evaluate(
            """() => [...document.querySelectorAll("body *")].filter((x) =>
              !x.closest(".wide, svg, thead") && x.getBoundingClientRect().right > 391
            ).map((x) => x.outerHTML.slice(0, 80))"""
        )
        assert (outside, wrong) == ([], [])
        view.close()


@pytest.mark.browser
def test_focus_reaches_everything_and_everything_has_a_name(browser, file):
    view, _ = opened(browser, file)
    view.focus("#case")
    reached = []
    for _ in range(6):
        reached.append(view.evaluate("document.activeElement.id"))
        view.keyboard.press("Tab")
    assert reached == ["case", "play", "back", "forward", "speed", "scrub"]
    nameless = view.eval_on_selector_all(
        "button, select, input, canvas[role=img], svg[role=img], img, [role=region]",
        """all => all.filter((x) => !(x.textContent.trim() || x.ariaLabel || x.alt
          || x.labels?.length)).map((x) => x.outerHTML.slice(0, 80))""",
    )
    assert nameless == []
    view.close()


@pytest.mark.browser
def test_markup_in_the_data_does_not_run(browser, hostile_file):
    view, wrong = opened(browser, hostile_file)
    assert HOSTILE in view.inner_text("#clock")
    view.click("#events button >> nth=0")
    assert HOSTILE in view.inner_text("#events")
    assert wrong == []
    view.close()
