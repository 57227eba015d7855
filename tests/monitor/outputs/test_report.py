import html
import json
import re
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest

from monitor.events import EndEvent, StatusEvent
from monitor.outputs.report import Report
from monitor.wording import verdict_sentence
from pipeline.records import CameraImage, CameraModel

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def reported(folder, events):
    report = Report(folder, "van-17")
    for event in events:
        report.handle(event)
    report.close()
    return (folder / "report.html").read_text()


def text_of(page):
    """What a reader sees, roughly: no scripts, no styles, no tags."""
    body = re.sub(r"<(script|style)\b.*?</\1>", " ", page, flags=re.DOTALL)
    return html.unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body)))


def series_of(page):
    return json.loads(re.search(r'id="series">(.*?)</script>', page, flags=re.DOTALL).group(1))


@pytest.fixture(scope="module")
def page(tmp_path_factory, drive):
    folder = tmp_path_factory.mktemp("report")
    text = reported(folder, drive().events())
    assert [path.name for path in folder.iterdir()] == ["report.html"]
    return text


def test_the_verdict_stands_first_in_one_sentence(page, drive):
    seen = text_of(page)
    sentence = verdict_sentence(drive().status(60, seq=60))
    assert "yaw +0.79 deg (sigma 0.04 deg, limit 0.50 deg)" in sentence
    assert seen.index(sentence) < seen.index("What to do.") < seen.index("Drift over time")


def test_the_page_needs_nothing_but_itself(page):
    assert len(page) < 1_500_000
    assert not re.search(r'(src|href)\s*=\s*["\'](?!data:)', page)
    assert "url(" not in page
    assert "@import" not in page
    assert "default-src 'none'" in page
    assert "The MIT License" in page


def test_every_state_figure_and_origin_is_told(page):
    seen = text_of(page)
    for word in ("starting", "healthy", "suspect", "drifted", "dropped: no_partner 2", "dropped: too_dark 1"):
        assert word in seen
    assert "The test for yaw has passed its first threshold." in seen
    assert "extrinsic version 3, 9f2c9f2c9f2c9f2c" in seen
    assert "model version 1, 77aa77aa77aa77aa" in seen
    assert "calibwatch 0.1.0" in seen
    assert "forward held unknown 0.200 m none none no no never" in seen
    assert "in the stored camera's own axes" in seen


def test_plots_carry_the_drift_and_the_states(page, drive):
    (pair,) = series_of(page)
    assert pair["seconds"] == list(range(61))
    yaw = next(axis for axis in pair["axes"] if axis["name"] == "yaw")
    said = [drive().status(second).drift.yaw for second in range(61)]
    np.testing.assert_allclose(yaw["value"][1:], [axis.value for axis in said[1:]], atol=1e-5)
    assert (yaw["value"][0], yaw["unit"], yaw["limit"]) == (None, "deg", 0.5)
    assert [(span["state"], span["from"], span["to"]) for span in pair["states"]] == [
        ("starting", 0, 3),
        ("healthy", 3, 26),
        ("suspect", 26, 30),
        ("drifted", 30, 60),
    ]
    assert pair["onset"] == {"at": 21, "from": 19, "to": 24}
    assert all(f'id="{axis["id"]}"' in page for axis in pair["axes"])


def test_drift_is_shown_beside_how_it_was_before(page):
    seen = text_of(page)
    assert "Stored against estimated, while drifted" in seen
    assert "For comparison, when first healthy" in seen
    pictures = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(pictures) == (1 + 2 * 3) + (1 + 2 * 1)
    apart = [float(px) for px in re.findall(r"extrinsics lie ([\d.]+) px apart", seen)]
    assert min(apart[:3]) > 9  # 0.8 deg at 720 px
    assert apart[3] < 2


def test_a_healthy_run_shows_its_last_frame_alone(tmp_path, drive):
    events = [
        event
        for second in range(5, 12)
        for event in (drive().frame(second), StatusEvent(drive().status(second)))
    ]
    seen = text_of(reported(tmp_path, [*events, EndEvent(complete=True)]))
    assert "Stored against estimated, while healthy" in seen
    assert "For comparison" not in seen
    assert "2011-09-26 13:02:36.0 UTC. Orange : stored" in seen


def test_words_from_outside_stay_words(tmp_path, drive):
    nasty = '</script><img src=x onerror="alert(1)">{{ page }}'
    status = drive().status(5, reason=nasty, software=nasty)
    end = EndEvent(complete=False, note=nasty, warnings=(nasty,))
    page = reported(tmp_path, [StatusEvent(status), end])
    assert "<img src=x" not in page
    assert text_of(page).count('onerror="alert(1)">{{ page }}') >= 4


def test_an_axis_that_a_witness_does_not_see_bears_no_figure(tmp_path, drive):
    status = drive().status(60)
    lines = status.witnesses.lines
    blind = lines.model_copy(
        update={
            "chi2": None,
            "drift": lines.drift.model_copy(update={"roll": 0.07, "pitch": 0.04}),
            "sigma": lines.sigma.model_copy(update={"roll": 51.98, "pitch": None}),
        }
    )
    status = status.model_copy(update={"witnesses": status.witnesses.model_copy(update={"lines": blind})})
    seen = text_of(reported(tmp_path, [StatusEvent(status), EndEvent(complete=True)]))
    said = seen.partition("Witness: lines")[2].partition("Witness: edges")[0]
    assert "roll not seen pitch not seen yaw +0.79 deg ± 0.04 deg" in said
    assert "51.98" not in said
    assert "chi2" not in said


def test_an_onset_before_the_data_is_no_interval_within_them(tmp_path, drive):
    status = drive().status(60)
    onset = status.onset.model_copy(update={"stamp_ns": status.onset.from_ns})
    status = status.model_copy(update={"onset": onset})
    page = reported(tmp_path, [StatusEvent(status), EndEvent(complete=True)])
    assert page.count("or before, where the data begin") == 2  # in the sentence and at the mark
    assert "the drift: since" in page


def test_a_remark_on_a_whole_run_is_told(tmp_path, drive):
    end = EndEvent(complete=True, note="a test by --inject")
    page = reported(tmp_path, [StatusEvent(drive().status(5)), end])
    assert '<p class="warning">a test by --inject</p>' in page
    assert "did not reach the end" not in page


def test_an_interrupted_run_says_so(tmp_path, drive):
    end = EndEvent(complete=False, note="stopped by the user", warnings=("12 messages were refused",))
    seen = text_of(reported(tmp_path, [StatusEvent(drive().status(5)), end]))
    assert "did not reach the end of its input: stopped by the user" in seen
    assert "12 messages were refused" in seen
    assert "No frame with an estimate was seen" in seen


def test_a_run_without_a_pair_makes_no_statement(tmp_path):
    assert "there is no statement" in text_of(reported(tmp_path, [EndEvent(complete=True)]))


def test_the_pair_that_decides_stands_first(tmp_path, drive):
    events = [StatusEvent(drive(pair="a").status(5)), StatusEvent(drive(pair="b").status(40))]
    seen = text_of(reported(tmp_path, [*events, EndEvent(complete=True)]))
    assert seen.index("b is drifted") < seen.index("a is healthy")


def test_six_large_cameras_and_a_long_day_make_a_page_that_can_be_mailed(tmp_path, drive):
    rng = np.random.default_rng(7)
    noise = np.asarray(cv2.resize(rng.integers(70, 180, (135, 240, 3), dtype=np.uint8), (1920, 1080)))
    K = np.array([[1000.0, 0, 960], [0, 1000.0, 540], [0, 0, 1.0]])
    camera = CameraModel("pinhole", K, np.zeros(0), 1920, 1080)
    events = []
    for name in ("a", "b", "c", "d", "e", "f"):
        pair = drive(pair=name)
        for second in (5, 40):
            events.append(StatusEvent(pair.status(second)))
            events.append(replace(pair.frame(second), image=CameraImage(noise), camera=camera))
        last = pair.status(41)
        events += [StatusEvent(last.model_copy(update={"stamp_ns": last.stamp_ns + n})) for n in range(1000)]
    page = reported(tmp_path, [*events, EndEvent(complete=True)])
    assert len(page) < 1_500_000
    seen = text_of(page)
    assert seen.count("Stored against estimated, while drifted") == 6
    assert "more pictures were left out" in seen


def test_many_changes_are_cut_in_the_page(tmp_path, drive):
    states = [StatusEvent(drive().status(5, code=f"c{n}", stamp_ns=n * 10**9)) for n in range(200)]
    page = reported(tmp_path, [*states, EndEvent(complete=True)])
    assert "140 changes in between are left out" in page
    assert "<code>c0</code>" in page
    assert "<code>c199</code>" in page
    assert "<code>c100</code>" not in page


def test_without_an_end_nothing_is_written(tmp_path, drive):
    report = Report(tmp_path, "van-17")
    report.handle(StatusEvent(drive().status(5)))
    report.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here to open the page with")
def test_a_browser_draws_all_plots_without_complaint(page, tmp_path, drive):
    file = tmp_path / "report.html"
    file.write_text(page)
    options = (
        "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    )
    options += " --disable-component-update --disable-sync --disable-dev-shm-usage --virtual-time-budget=3000"
    options += f" --enable-logging=stderr --user-data-dir={tmp_path / 'profile'} --dump-dom file://{file}"
    done = subprocess.run(  # noqa: S603 # our own page
        [CHROMIUM, *options.split()], capture_output=True, text=True, timeout=120, check=True
    )
    assert verdict_sentence(drive().status(60, seq=60)) in text_of(done.stdout)
    assert done.stdout.count("<canvas") == 6
    assert "CONSOLE" not in done.stderr
