"""The explorer of a report, in a browser and at the width of a phone."""

from __future__ import annotations

import json
import re
import shutil
from base64 import b64decode
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import chromium, dumped
from test_report import make_outcome

from vslam.report.explorer import explorer_data
from vslam.report.folder import evaluate_run, write_results
from vslam.run.moments import MomentRecorder

FRAMES = 150


def filled(n_keyframes: int, every: int = 1) -> MomentRecorder:
    """Make a recorder that has seen several keyframes with distinguishable images."""
    recorder, outcome = MomentRecorder(), make_outcome(n_keyframes * every)
    rng = np.random.default_rng(0)
    xy = np.stack([rng.uniform(0, 720, 50), rng.uniform(0, 200, 50)], axis=1).astype(np.float32)
    for k, track in enumerate(outcome.tracks):
        recorder.frame(track)
        if k % every == 0:
            image = np.full((200, 720), k % 250, np.uint8)
            recorder.keyframe(track, image, xy, np.arange(50) < 20)
    return recorder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "first"
    folder.mkdir()
    write_results(folder, make_outcome(FRAMES, lost=slice(20, 22)), filled(30, 5).moments)
    return folder


def numbers(packed: str, kind: str = "<f4") -> np.ndarray:
    return np.frombuffer(b64decode(packed), kind)


def test_moments_are_bounded_and_evenly_spread():
    for n in (1, 96, 97, 192, 1000):
        frames = [moment.frame for moment in filled(n).moments]
        assert len(frames) <= 96
        assert len(frames) >= min(n, 48)
        assert frames[0] == 0
        steps = set(np.diff(frames).tolist())
        assert len(steps) <= 1, (n, steps)
    assert sum(len(moment.jpeg) for moment in filled(1000).moments) < 10**6


def test_a_moment_is_the_small_image_with_its_keypoints():
    moment = filled(3).moments[2]
    image = cv2.imdecode(np.frombuffer(moment.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (100, 360)
    assert abs(int(image.mean()) - 2) <= 2
    assert moment.points.shape == (50, 2)
    assert moment.tracked.sum() == 20
    assert moment.tracked[:20].all()


def test_a_moment_knows_its_frame_where_others_were_dropped():
    some = MomentRecorder()
    tracks = make_outcome(12).tracks
    for frame in (0, 4, 8):  # a recorder does not get dropped frames
        some.frame(tracks[frame])
        image = np.zeros((200, 720), np.uint8)
        some.keyframe(tracks[frame], image, np.zeros((0, 2)), np.zeros(0, np.bool_))
    assert [moment.frame for moment in some.moments] == [0, 4, 8]


def test_the_data_are_those_of_the_run():
    outcome = make_outcome(FRAMES, lost=slice(20, 22))
    evaluation, _ = evaluate_run(outcome)
    moments = filled(30, 5).moments
    data = explorer_data(outcome, evaluation, moments)
    assert data is not None
    json.dumps(data, allow_nan=False)
    floats = {name: numbers(packed) for name, packed in data["floats"].items()}
    assert {len(values) for values in floats.values()} == {FRAMES}
    states = [data["states"][code] for code in numbers(data["state"], "u1")]
    assert [k for k, state in enumerate(states) if state == "LOST"] == [20, 21]
    inliers = numbers(data["inliers"], "<u2").tolist()
    assert inliers == [track.n_inliers for track in outcome.tracks]
    assert np.allclose(floats["error"], evaluation.errors_m, atol=1e-5)
    position = np.stack([floats[axis] for axis in "xyz"], axis=1)
    assert np.allclose(position, evaluation.T_wc_aligned[:, :3, 3], atol=1e-4)
    forward = np.stack([f(np.deg2rad(floats["heading"])) for f in (np.sin, np.cos)], axis=1)
    looks = evaluation.T_wc_aligned[:, [0, 2], 2]
    assert np.allclose(forward, looks / np.linalg.norm(looks, axis=1, keepdims=True), atol=1e-5)
    truth = [numbers(data["truth"][axis]) for axis in "xz"]
    errors = np.hypot(floats["x"] - truth[0], floats["z"] - truth[1])
    assert (errors <= evaluation.errors_m + 1e-4).all()
    assert [moment["frame"] for moment in data["moments"]] == list(range(0, 150, 5))
    assert b64decode(data["moments"][1]["jpeg"])[:2] == b"\xff\xd8"


def test_a_run_without_ground_truth_and_a_short_one():
    outcome = make_outcome(20)
    data = explorer_data(outcome, None, [])
    assert data is not None
    assert np.isnan(numbers(data["floats"]["error"])).all()
    assert data["truth"] == {"x": "", "z": ""}
    assert explorer_data(make_outcome(1), None, []) is None
    assert explorer_data(make_outcome(20, lost=slice(0, 20)), None, []) is None


def test_every_frame_of_a_long_run_is_there_in_little_space():
    outcome = make_outcome(7001)
    data = explorer_data(outcome, None, [])
    assert data is not None
    assert len(numbers(data["floats"]["x"])) == 7001
    assert len(json.dumps(data)) < 50 * 7001


_PROBE = """<!doctype html><meta charset="utf-8"><pre id="found"></pre>
<iframe id="page" width="WIDTH" height="900" style="border: 0"></iframe>
<script>
const page = document.getElementById("page"), wait = () => new Promise(r => setTimeout(r, 100));
const until = async (holds) => { for (let k = 0; k < 300 && !holds(); k++) await wait(); };
page.onload = async () => {
  const inner = page.contentDocument, window_ = page.contentWindow;
  const find = name => inner.querySelector("#explorer ." + name);
  const ink = name => {
    const c = find(name), d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let sum = 0;
    for (let k = 3; k < d.length; k += 4) sum += d[k] > 0;
    return sum;
  };
  const blue = () => {  // the estimated path
    const c = find("map"), d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let sum = 0;
    for (let k = 0; k < d.length; k += 4) sum += d[k] < 120 && d[k + 2] > 200;
    return sum;
  };
  const copy = name => find(name).toDataURL();
  await until(() => find("said").textContent && ink("picture"));
  const first = { said: find("said").textContent, map: copy("map") };
  const slider = find("time");
  slider.value = 21;
  slider.dispatchEvent(new window_.Event("input"));
  await until(() => find("said").textContent !== first.said && copy("map") !== first.map);
  const second = { said: find("said").textContent, map: copy("map"), picture: copy("picture") };
  const said = {};
  for (const name of ["after", "before", "image-after", "image-before", "image-before"]) {
    const before = find("said").textContent;
    find(name).click();
    await until(() => find("said").textContent !== before);
    said[name] = (said[name] || "") + find("said").textContent.split(" · ")[0] + ";";
  }
  slider.value = 21;
  slider.dispatchEvent(new window_.Event("input"));
  await until(() => find("said").textContent === second.said && copy("map") === second.map);
  find("closer").click();
  await until(() => copy("map") !== second.map);
  const near = copy("map");
  find("all").click();
  await until(() => copy("map") !== near);
  const whole = copy("map");
  const box = find("map").getBoundingClientRect();
  document.getElementById("found").textContent = "FOUND" + JSON.stringify({
    first: first.said, second: second.said, steps: said, frames: +slider.max,
    moved: first.map !== second.map, zoomed: near !== second.map, back: whole === second.map,
    blue: blue(), ink: ["map", "strip", "picture"].map(ink), map: [box.left, box.right, box.height],
    shown: inner.documentElement.clientWidth, needed: inner.documentElement.scrollWidth,
    scrolled: [...inner.querySelectorAll(".scroll")].map(x => x.scrollWidth - x.clientWidth),
    requests: window_.performance.getEntriesByType("resource").map(x => x.name)
      .filter(x => !x.startsWith("data:")),
  }) + "END";
};
// Frames come in real time, which virtual time outruns on a busy machine: let timers make them.
const timed = "<script>window.requestAnimationFrame = f => setTimeout(f, 16)</" + "script>";
fetch("report.html").then(answer => answer.text())
  .then(text => { page.srcdoc = text.replace("<head>", "<head>" + timed); });
</script>"""


@pytest.mark.slow
@pytest.mark.parametrize("width", [400, 1200])
def test_the_explorer_in_a_browser(run: Path, tmp_path: Path, width: int):
    """The slider moves through time, and the buttons zoom. The page makes no network requests."""
    chromium()
    shutil.copy(run / "report.html", tmp_path)
    (tmp_path / "probe.html").write_text(_PROBE.replace("WIDTH", str(width)))

    text = dumped(tmp_path, "probe.html", tmp_path / "profile", milliseconds=200000)
    answer = re.search("FOUND(.*)END</pre>", text)
    assert answer, text[-4000:]
    found = json.loads(answer[1].replace("&amp;", "&"))
    assert found["frames"] == FRAMES - 1
    assert found["first"].startswith("frame 0 · 0.00 s · OK")
    assert found["second"].startswith("frame 21 · ")
    assert "LOST" in found["second"]
    assert "image of frame 20, 1 frame earlier" in found["second"]
    assert re.search(r"at \(-?\d+\.\d\d, .* m · heading -?\d+\.\d°", found["second"])
    assert found["steps"] == {
        "after": "frame 22;",
        "before": "frame 21;",
        "image-after": "frame 25;",
        "image-before": "frame 20;frame 15;",
    }
    assert re.search(r"error \d\.\d+ m", found["second"])
    assert (found["moved"], found["zoomed"], found["back"]) == (True, True, True)
    assert min(found["ink"]) > 200
    assert found["blue"] > 100
    left, right, height = found["map"]
    assert 0 <= left < right <= width
    assert height > 200
    assert found["needed"] <= found["shown"] <= width
    assert max(found["scrolled"]) <= 1
    assert found["requests"] == []


def test_the_page_is_one_file_of_bounded_size(run: Path):
    text = (run / "report.html").read_text()
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)[^\"]+\"", text)
    assert len(text) < 2 * 10**6
