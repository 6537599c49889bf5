"""The playback panel: which episode is played, frame by frame, its rewards and its contact forces."""

import io
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from conftest import NAME, Page, eventually, make_hand_run, make_run
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from morph_core.catalogue import make_task
from morph_core.episodes import outcomes, record_episodes
from morph_core.protocol import Evaluation
from morph_core.rollout import collect
from morph_core.run_folder import EventLog, RunFolder, read_episode, write_episode
from studio.app import create_app
from studio.settings import Settings
from studio.viewer.rewards import cursor, reward_chart, reward_legend
from studio.viewer.take import FRAMES_PER_SECOND, Shot, make_take

HAND = "20260101-000000-hand-direct-s0"


def evaluated(folder: RunFolder, task: str, iteration: int, seed: int = 0) -> None:
    """Let a run evaluate an untrained policy that moves at random, and record its episodes."""
    made = make_task(task)
    phi, rng = made.design_space.initial, np.random.default_rng(seed)
    hw_phy = made.hw_phy(phi)
    move = rng.uniform(-1, 1, (made.horizon, 6, made.action_size)).astype(np.float32)
    steps = iter(move)
    rollout = collect(made, lambda _: next(steps), hw_phy, made.reset(hw_phy, 6, rng))
    name = write_episode(folder, iteration, record_episodes(made, rollout, phi))
    log = EventLog(folder)
    log.append(
        Evaluation(
            iteration=iteration, env_steps=400, phi=phi.tolist(), sampled_success=0.0, sampled_return=0.0,
            deterministic_success=0.0, deterministic_return=0.0, episode=name, recorded=outcomes(rollout), episodes=6,
        )
    )  # fmt: skip
    log.close()


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """Return a run of the reacher whose third iteration has the four episodes."""
    folder = make_run(tmp_path / "runs", NAME, ended="finished")
    lines = folder.events.read_text().splitlines(keepends=True)
    folder.events.write_text("".join(line for line in lines if '"evaluation"' not in line))
    evaluated(folder, "reacher", 3)
    return folder


def choose(page: Page, which: str) -> None:
    """Choose an episode as a person does."""
    playback = page.viewer.playback
    playback.episode.value = next(words for words in playback.episode.options if words.startswith(which))
    playback._choose(None)


def test_each_recorded_episode_is_offered_with_what_it_came_to_and_played(page: Page, folder: RunFolder) -> None:
    history = page.show(folder)
    recorded = {r.which: r for r in history.evaluations[-1].recorded}
    options = page.viewer.playback.episode.options
    assert [words.split(":")[0] for words in options] == ["median", "best", "worst", "failed"]
    best = f"{recorded['best'].episode_return:.2f}".replace("-", "−")
    assert options[1] == f"best: return {best}, no success"
    assert page.take(lambda t: t.shot.which == "median").shot.episode == (folder, 3)
    for which in ("worst", "best"):
        choose(page, which)
        take = page.take(lambda t, which=which: t.shot.which == which)
        assert sum(term.sum() for term in take.reward_terms.values()) == pytest.approx(
            recorded[which].episode_return  # pyright: ignore[reportArgumentType]
        )
    page.show(folder)
    assert page.take().shot.which == "best"  # a choice stays


def test_an_episode_of_an_earlier_version_is_the_only_one(page: Page, tmp_path: Path) -> None:
    page.show(make_run(tmp_path / "runs", NAME, ended="finished"))
    take = page.take(lambda t: t.frames > 1)
    assert (take.shot.which, take.has_forces, take.reward_terms) == (None, False, {})
    playback = page.viewer.playback
    assert playback.episode.value == "the only one recorded"
    assert eventually(lambda: playback.time.visible)
    assert not playback.forces.visible
    assert not playback.rewards.visible


def test_a_choice_that_is_none_is_refused(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    page.viewer.playback.episode.value = "luckiest"
    page.viewer.playback._choose(None)
    assert "there is no such episode; choose from: median" in page.viewer.notice.content
    page.take(lambda t: t.shot.which == "median")


def test_frames_are_stepped_to_and_stay(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    page.take(lambda t: t.frames > 1)
    playback, player = page.viewer.playback, page.viewer.player
    player.seek(0.5)
    middle = FRAMES_PER_SECOND // 2
    assert eventually(lambda: player._robot._instant == middle)
    playback.step(1)
    assert eventually(lambda: player._robot._instant == middle + 1)
    assert (player.playing, playback.play.label) == (False, "Play")
    playback.step(-1)
    playback.step(-1)
    assert eventually(lambda: player._robot._instant == middle - 1)
    assert eventually(lambda: playback.time.value == pytest.approx((middle - 1) / FRAMES_PER_SECOND, abs=0.005))
    for _ in range(middle):
        playback.step(-1)
    assert eventually(lambda: player._robot._instant == 0)
    player.step(10**6)
    take = page.take()
    assert eventually(lambda: player._robot._instant == take.frames - 1)


def test_the_rewards_stand_under_the_time_with_a_cursor(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    take = page.take(lambda t: t.shot.which == "median")
    playback = page.viewer.playback
    assert eventually(lambda: playback.terms.visible)
    assert 'aria-label="terms of the reward over the episode"' in playback.rewards.content
    for name in take.reward_terms:
        assert name.replace("_", " ") in playback.terms.content
    page.viewer.player.seek(take.duration / 4)
    assert eventually(lambda: "left:25.0%" in playback.cursor.content)


TERMS = st.integers(1, 20).flatmap(
    lambda steps: st.dictionaries(
        st.sampled_from(["goal", "distance", "height"]), arrays(float, steps, elements=st.floats(-1e3, 1e3)), min_size=1
    )
)


@given(TERMS)
def test_the_areas_stack_to_the_gains_and_the_costs_of_each_step(terms: Mapping[str, np.ndarray]) -> None:
    content = reward_chart(terms, 1.0)
    ys = [float(y) for points in re.findall(r'points="([^"]*)"', content) for y in re.findall(r",(\S+)", points)]
    total = np.stack(list(terms.values()))
    gains, costs = np.maximum(total, 0).sum(0), np.minimum(total, 0).sum(0)
    if not ys:
        assert not total.any()
        return
    height = float(re.findall(r'viewBox="0 0 300 (\S+)"', content)[0])
    assert (min(ys), max(ys)) == pytest.approx((0.0, height), abs=0.06)  # the highest and the lowest fill the chart
    span = gains.max() - costs.min()
    zero = height * gains.max() / span
    assert f'y1="{zero:.1f}"' in content
    assert f"return {sum(t.sum() for t in terms.values()):+.2f}".replace("-", "−") in reward_legend(terms)


def test_names_of_terms_are_text_and_the_cursor_is_where_the_time_is() -> None:
    assert "<script" not in reward_legend({"<script>": np.ones(2)})
    assert "left:50.0%" in cursor(0.5)


@pytest.fixture
def hand(tmp_path: Path) -> RunFolder:
    folder = make_hand_run(tmp_path / "runs", "pen_press", HAND)
    evaluated(folder, "pen_press", 1)
    return folder


def test_contact_forces_are_arrows_on_request(page: Page, hand: RunFolder) -> None:
    page.show(hand)
    playback = page.viewer.playback
    page.take(lambda t: t.has_forces)
    assert eventually(lambda: playback.forces.visible)
    assert page.take().forces is None
    playback.forces.value = True
    page.viewer.refresh()
    take = page.take(lambda t: t.forces is not None)
    assert take.forces is not None
    page.viewer.player.seek(0.5)
    arrows = take.forces.at(15)
    # The pen lies still on the table, and the arrows add up to its weight.
    newtons = 100 * take.forces.newtons_per_cm * (arrows[:, 1] - arrows[:, 0]).sum(0)
    assert newtons == pytest.approx([0, 0, 9.81 * 0.16], abs=0.3)
    assert eventually(lambda: f"1 cm is {take.forces.newtons_per_cm:g} N" in page.viewer.timeline.legend.content)  # pyright: ignore[reportOptionalMemberAccess]
    handle = eventually(lambda: page.viewer.player._forces._handle)
    assert handle
    assert eventually(lambda: len(page.viewer.player._forces._shown) == len(arrows))


def test_two_designs_are_played_on_one_clock(folder: RunFolder) -> None:
    task = make_task("reacher")
    phi = tuple(task.design_space.initial.tolist())
    first = Shot("reacher", (), phi)
    second = Shot("reacher", (), phi, episode=(folder, 3), which="best")
    beside = make_take(Shot("reacher", (), phi, second=second))
    alone, played = make_take(first), make_take(second)
    assert beside.second is not None
    assert (beside.frames, beside.duration) == (1, played.duration)
    shift = beside.second.robot.positions - played.robot.positions
    assert shift == pytest.approx(np.broadcast_to(beside.second.away, shift.shape), abs=1e-5)
    for corner, low in zip(range(3), beside.second.away, strict=True):
        assert beside.box[0][corner] == pytest.approx(alone.box[0][corner] + min(low, 0))
        assert beside.box[1][corner] == pytest.approx(alone.box[1][corner] + max(low, 0))
    size = alone.box[1] - alone.box[0]
    assert (np.abs(beside.second.away) > size)[np.argmax(np.abs(beside.second.away))]  # both scenes are apart
    over = make_take(Shot("reacher", (), phi, second=second, overlaid=True))
    assert over.second is not None
    assert over.second.scenery is None
    assert over.second.robot.positions == pytest.approx(played.robot.positions)
    assert (over.second.robot.colours != played.robot.colours).any()
    assert over.box[0] == pytest.approx(alone.box[0])


def test_the_shorter_of_two_episodes_stays_at_its_end(page: Page, folder: RunFolder) -> None:
    page.show(folder)
    phi = tuple(make_task("reacher").design_space.initial.tolist())
    second = Shot("reacher", (), phi, episode=(folder, 3), which="best")
    page.viewer.player.show(Shot("reacher", (), phi, second=second))
    take = page.take(lambda t: t.second is not None)
    page.viewer.player.seek(take.duration)
    assert eventually(lambda: page.viewer.player._second_robot._instant == take.last_frame)
    assert page.viewer.player._robot._instant == 0


def downloaded(client: TestClient, path: str) -> dict[str, np.ndarray]:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    with np.load(io.BytesIO(answer.content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def test_the_api_hands_out_each_episode_and_its_contact_forces(hand: RunFolder) -> None:
    token = "a-token-of-these-tests"
    app = create_app(Settings(runs=hand.path.parent, token=token, open_browser=False))
    client = TestClient(app, base_url="http://127.0.0.1", headers={"Authorization": f"Bearer {token}"})
    for path in ("rollouts", "episodes"):
        found = downloaded(client, f"/api/runs/{hand.id}/{path}/1?which=worst")
        expected = read_episode(hand, 1, "worst")
        assert found.keys() == expected.keys()
        assert np.array_equal(found["qpos"], expected["qpos"])
    found = downloaded(client, f"/api/runs/{hand.id}/episodes/1?which=best&forces=true")
    assert found["contact_points"].shape == found["contact_forces"].shape
    assert len(found["contact_forces"]) == len(found["qpos"])
    assert client.get(f"/api/runs/{hand.id}/episodes/1?which=luckiest").status_code == 422
    write_episode(hand, 2, {"qpos": np.zeros((2, 17)), "phi": np.zeros(8)})
    refused = client.get(f"/api/runs/{hand.id}/episodes/2?which=best")
    assert (refused.status_code, "a single one was recorded" in refused.json()["detail"]) == (404, True)
    refused = client.get(f"/api/runs/{hand.id}/episodes/2?forces=true")
    assert (refused.status_code, "no contact forces are known" in refused.json()["detail"]) == (422, True)
