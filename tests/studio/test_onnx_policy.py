"""policy.onnx gives the actions of the arrays, and a file that does not, or asks for more, is found out."""

import dataclasses
import itertools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from conftest import make_hand_run
from hypothesis import example, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from test_export_proof import add_policy

from morph_core.catalogue import TASKS, make_task
from morph_core.history import History
from morph_core.run_folder import RunFolder
from morph_core.task import Task
from studio.export import onnx_policy
from studio.export.bundle import build_bundle
from studio.export.policy import Policy, policy_files
from studio.export.proof import check_onnx, prove, unpack
from studio.robots.chooser import robot_of
from studio.robots.robot import Program
from tests.foreign import Pointer, Swinging, Unnamed

DATA = Path(__file__).parents[1] / "data" / "format_1"


def made(task: Task, hidden: int = 16, scale: float = 1.0, seed: int = 0) -> tuple[Policy, Program]:
    """Return a policy with random weights of a size that keeps what a layer puts out of the order of `scale`."""
    rng = np.random.default_rng(seed)
    sizes = [task.observation_size, hidden, hidden, task.action_size]
    weights, biases = [], []
    for inputs, outputs in itertools.pairwise(sizes):
        weights.append((scale / np.sqrt(inputs) * rng.standard_normal((outputs, inputs))).astype(np.float32))
        biases.append((0.3 * scale * rng.standard_normal(outputs)).astype(np.float32))
    program = robot_of(task).program(task.design_space.initial)
    return Policy(weights, biases, np.ones(task.action_size, np.float32), 0), program


def asked(content: bytes, seen: np.ndarray) -> np.ndarray:
    """Return what onnxruntime makes of observations (n, o)."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(["action"], {"observation": seen.astype(np.float32)})[0])


tasks = st.sampled_from([*(make_task(name) for name in sorted(TASKS)), Pointer(), Swinging(), Unnamed()])


@given(tasks, st.integers(1, 64), st.floats(0, 1.5), st.integers(0, 1000), st.integers(1, 9))
@example(make_task("pen_press"), 128, 1.0, 0, 512)
@settings(max_examples=25, deadline=None)
def test_onnx_and_arrays_command_the_same(task: Task, hidden: int, scale: float, seed: int, batch: int) -> None:
    policy, program = made(task, hidden, scale, seed)
    content = onnx_policy.onnx_file(policy, program, {})
    units, rng = program.units, np.random.default_rng(seed)
    seen = units["middle"] + 3 * units["spread"] * rng.standard_normal((batch, len(program.sees)))
    seen = seen.astype(np.float32)
    off = np.abs(asked(content, seen) - policy.command(seen, program)) / units["action_scale"]
    assert off.max() <= onnx_policy.ALLOWED
    assert onnx_policy.off_from_arrays(content, policy, program) <= onnx_policy.ALLOWED


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_both_see_an_orientation_and_not_the_sign_of_its_quaternion(seed: int) -> None:
    task = make_task("pen_press")
    policy, program = made(task, seed=seed)
    rng = np.random.default_rng(seed)
    seen = program.units["middle"] + program.units["spread"] * rng.standard_normal((4, len(program.sees)))
    turned = seen.copy()
    turned[:, -4:] *= -1
    assert [name for name, _ in program.sees[-4:]] == ["object qw", "object qx", "object qy", "object qz"]
    np.testing.assert_allclose(policy.command(turned, program), policy.command(seen, program))
    content = onnx_policy.onnx_file(policy, program, {})
    np.testing.assert_array_equal(asked(content, turned), asked(content, seen))


@pytest.mark.parametrize("task", [make_task("pen_press"), make_task("reacher")], ids=lambda task: task.name)
def test_what_a_policy_commands_is_what_its_task_executes(task: Task) -> None:
    policy, program = made(task)
    hardware = task.hw_phy(task.design_space.initial)
    s = task.reset(hardware, 8, np.random.default_rng(0))
    expected = np.asarray(task.action_units) * np.clip(policy.act(task.observe(s), None), -1, 1)
    columns = s[:, : len(program.sees)].copy()
    if task.name == "reacher":  # whose policy sees what the task makes of the state
        heading, tip = np.cumsum(s[:, :5], 1), hardware(s, np.zeros((8, 5)))[:, -2:]
        columns = np.concatenate([np.sin(heading), np.cos(heading), s[:, :5], tip], 1)
    else:  # the exported files have another zero
        columns[:, : program.units["action_scale"].size] -= robot_of(task).hand.start(task.design_space.initial)
    np.testing.assert_allclose(policy.command(columns, program), expected, atol=1e-6)


def test_the_file_tells_what_its_entries_are_and_takes_any_number_of_observations() -> None:
    task = make_task("pen_press")
    policy, program = made(task)
    content = onnx_policy.onnx_file(policy, program, {"task": task.name, "control_step_s": task.control_dt})
    model = onnx.load_model_from_string(content)
    told = {entry.key: entry.value for entry in model.metadata_props}
    assert (told["task"], json.loads(told["control_step_s"])) == ("pen_press", 0.1)
    for name, count in (("observation", task.observation_size), ("action", task.action_size)):
        entries = json.loads(told[name])
        assert len(entries) == count
        assert entries[:2] == [{"name": "palm", "unit": "m"}, {"name": "finger_1_proximal", "unit": "rad"}]
    for count in (0, 1, 5):
        assert asked(content, np.zeros((count, task.observation_size))).shape == (count, task.action_size)
    onnx.checker.check_model(model, full_check=True)
    assert content == onnx_policy.onnx_file(policy, program, {"task": task.name, "control_step_s": task.control_dt})


# --- the runner proves both equal ---


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """The folder of a policy of a hand with its program."""
    policy, program = made(make_task("pen_press"))
    files = policy_files(policy, program, 40) | {onnx_policy.FILE: onnx_policy.onnx_file(policy, program, {})}
    unpack(files, tmp_path)
    return tmp_path


def compared(folder: Path, *before: str) -> subprocess.CompletedProcess[str]:
    """Run policy.py of a bundle as a stranger does."""
    code = [*before, "import runpy", "runpy.run_path('policy.py', run_name='__main__')"]
    command = [sys.executable, "-P", "-c", "\n".join(code)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_runner_proves_arrays_and_onnx_equal(bundle: Path) -> None:
    done = compared(bundle)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("policy.onnx: within ")
    assert "of policy.npz on 1000 observations, as a share of the largest action; 1e-05 is allowed" in done.stdout


def test_the_runner_says_where_they_differ_and_ends_with_a_failure(bundle: Path) -> None:
    other, program = made(make_task("pen_press"), seed=1)
    (bundle / onnx_policy.FILE).write_bytes(onnx_policy.onnx_file(other, program, {}))
    done = compared(bundle)
    assert done.returncode == 1
    assert "1e-05 is allowed" in done.stderr


def test_the_runner_says_what_it_lacks(bundle: Path) -> None:
    done = compared(bundle, "import sys", "sys.modules['onnxruntime'] = None")
    assert (done.returncode, done.stdout) == (0, "policy.onnx: not compared with policy.npz: pip install onnxruntime\n")
    (bundle / onnx_policy.FILE).unlink()
    assert compared(bundle).stdout == "policy.onnx: this bundle has none\n"


# --- `verify` finds out what differs ---


def changed(content: bytes, change: Callable[[onnx.ModelProto], object]) -> bytes:
    model = onnx.load_model_from_string(content)
    change(model)
    return model.SerializeToString()


def stretch(model: onnx.ModelProto) -> None:
    (bias,) = (tensor for tensor in model.graph.initializer if tensor.name == "bias_1")
    bias.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(bias) + np.float32(1e-3), "bias_1"))


def fetch(model: onnx.ModelProto) -> None:
    weight = model.graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="../../etc/passwd")


def call(model: onnx.ModelProto) -> None:
    model.graph.node.append(helper.make_node("Loop", ["observation"], ["x"]))


def own(model: onnx.ModelProto) -> None:
    model.opset_import.append(helper.make_opsetid("my.own", 1))


def narrow(model: onnx.ModelProto) -> None:
    del model.graph.node[:]
    model.graph.node.append(helper.make_node("Tanh", ["observation"], ["action"]))


BROKEN: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "another bias": (lambda content: changed(content, stretch), "256 observations"),
    "numbers elsewhere": (lambda content: changed(content, fetch), "its numbers are not in the file"),
    "a loop": (lambda content: changed(content, call), "operators that no policy needs: Loop"),
    "operators of its own": (lambda content: changed(content, own), "operators of its own"),
    "another graph": (lambda content: changed(content, narrow), "can't be compared"),
    "half of a file": (lambda content: content[: len(content) // 2], "can't be compared"),
    "a huge file": (lambda content: content + bytes(5 << 20), "more than 4 MiB"),
    "no file": (lambda _: b"", "can't be compared"),
}


@pytest.mark.parametrize(("breaking", "said"), BROKEN.values(), ids=BROKEN.keys())
def test_a_graph_that_is_not_the_policy_is_found_out(breaking: Callable[[bytes], bytes], said: str) -> None:
    task = make_task("pen_press")
    policy, program = made(task)
    files = policy_files(policy, program, 40) | {onnx_policy.FILE: onnx_policy.onnx_file(policy, program, {})}
    assert check_onnx(files, task, task.design_space.initial).passed
    broken = files | {onnx_policy.FILE: breaking(files[onnx_policy.FILE])}
    check = check_onnx(broken, task, task.design_space.initial)
    assert not check.passed
    assert said in str(check)


def test_without_the_extra_a_bundle_has_no_onnx_and_says_what_brings_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    history = History(make_hand_run(tmp_path / "runs", "pen_press"))
    add_policy(history, make_task("pen_press"), 0)
    complete = build_bundle(history, "best", ["mjcf"]).files
    assert "policy.onnx is the same" in complete["README.txt"].decode()
    monkeypatch.setattr(onnx_policy, "is_available", lambda: False)
    files = build_bundle(history, "best", ["mjcf"]).files
    assert set(complete) - set(files) == {onnx_policy.FILE}
    for path in ("README.txt", "report.html"):
        assert "morph-studio[onnx]" in files[path].decode()
    checks = prove(complete, episodes=0)  # where only the reader lacks it
    assert [str(check) for check in checks if not check.passed] == []
    assert any("not compared" in check.detail and "morph-studio[onnx]" in check.detail for check in checks)


@pytest.mark.parametrize("run", ["pen_press-morph", "reacher-direct", "reacher-morph"])
def test_the_bundle_of_a_trained_run_proves_its_onnx(run: str) -> None:
    bundle = build_bundle(History(RunFolder(DATA / run)), "latest", ["mjcf"])
    (check,) = (check for check in bundle.checks if check.name.startswith(onnx_policy.FILE))
    assert check.passed
    assert 0 < check.worst < dataclasses.replace(check, worst=0.0).allowed


@pytest.mark.slow
def test_the_bundle_of_a_mouse_hand_that_was_trained_proves_its_onnx(tmp_path: Path) -> None:
    words = ["--iterations", "1", "--trajectories", "16", "--evaluation.interval", "1", "--evaluation.episodes", "4"]
    command = [sys.executable, "-m", "studio.cli", "train", "mouse_click", "--method", "no_hw_opt", *words]
    done = subprocess.run([*command, "--runs", tmp_path, "--json"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    bundle = build_bundle(History(RunFolder(Path(json.loads(done.stdout)["path"]))), "latest", ["mjcf"])
    (check,) = (check for check in bundle.checks if check.name.startswith(onnx_policy.FILE))
    assert check.passed
