"""The job script of a task: signals, exit codes, and a run that another trainer holds."""

import os
import signal
import subprocess
import time
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import pytest
from conftest import eventually

SCRIPT = str(files("studio.study") / "slurm_job.sh")
TRAINER = """#!/bin/bash
trap 'echo saved; exit {on_term}' TERM
echo words
echo "$@" >> started
{does}
"""
AT_WORK = "while :; do /bin/sleep 0.05; done"


@dataclass
class Task:
    """A task of an array, on this machine, with a stand-in for its trainer."""

    folder: Path
    bin: Path

    def trainer(self, does: str, on_term: int = 0) -> None:
        self.program("trainer", TRAINER.format(does=does, on_term=on_term))

    def program(self, name: str, text: str) -> None:
        (self.bin / name).write_text(text)
        (self.bin / name).chmod(0o755)

    def start(self) -> subprocess.Popen[bytes]:
        environment = os.environ | {
            "PATH": f"{self.bin}:{os.environ['PATH']}", "SLURM_ARRAY_TASK_ID": "1", "SLURM_ARRAY_JOB_ID": "42",
            "SLURM_JOB_ID": "43",
        }  # fmt: skip
        return subprocess.Popen(["bash", SCRIPT, str(self.bin / "runs.txt"), "trainer", "--run"], env=environment)

    @property
    def starts(self) -> list[str]:
        path = self.folder / "started"
        return path.read_text().splitlines() if path.exists() else []

    @property
    def log(self) -> list[str]:
        return (self.folder / "trainer.log").read_text().splitlines()

    @property
    def requeued(self) -> list[str]:
        path = self.folder / "requeued"
        return path.read_text().splitlines() if path.exists() else []

    def ends(self, job: subprocess.Popen[bytes], seconds: float = 20) -> int:
        try:
            return job.wait(seconds)
        finally:
            job.kill()


@pytest.fixture
def task(tmp_path: Path) -> Task:
    task = Task(tmp_path / "a run", tmp_path / "bin")
    task.folder.mkdir()
    task.bin.mkdir()
    (task.bin / "runs.txt").write_text(f"{tmp_path}/other\n{task.folder}\n{tmp_path}/third\n")
    task.program("scontrol", '#!/bin/bash\necho "$@" >> requeued\n')
    task.program("sleep", "#!/bin/bash\n")
    return task


@pytest.mark.parametrize("code", [0, 1, 3, 137])
def test_a_task_ends_as_its_trainer_does(task: Task, code: int) -> None:
    task.trainer(f"exit {code}")
    assert task.ends(task.start()) == code
    assert task.starts == [f"--run {task.folder}"]
    assert task.log == ["words"]
    assert task.requeued == []


@pytest.mark.parametrize(
    ("number", "on_term", "code", "requeued"),
    [
        (
            signal.SIGUSR1,
            0,
            0,
            ["requeue 42_1"],
        ),  # the time limit is near; 43 can be the whole array
        (signal.SIGUSR1, 1, 1, []),  # it has failed
        (signal.SIGUSR1, 143, 0, ["requeue 42_1"]),  # it had no time to listen yet
        (signal.SIGTERM, 0, 0, []),  # cancelled, or preempted
    ],
)
def test_a_signal_lets_the_trainer_save_and_the_time_limit_queues_the_task_once_more(
    task: Task, number: signal.Signals, on_term: int, code: int, requeued: list[str]
) -> None:
    task.trainer(AT_WORK, on_term)
    job = task.start()
    assert eventually(lambda: task.starts)
    time.sleep(0.2)
    job.send_signal(number)
    assert task.ends(job) == code
    assert task.log == ["words", "saved"]
    assert task.requeued == requeued


def test_a_finished_trainer_counts_as_such_however_many_signals_came(task: Task) -> None:
    task.trainer("trap '' TERM\nwhile [ ! -e enough ]; do /bin/sleep 0.05; done\nexit 0")
    job = task.start()
    assert eventually(lambda: task.starts)
    for _ in range(5):
        time.sleep(0.1)
        job.send_signal(signal.SIGTERM)
    (task.folder / "enough").touch()
    assert task.ends(job) == 0


@pytest.mark.parametrize(("held", "starts", "code"), [(3, 4, 0), (99, 20, 2)])
def test_a_run_that_another_trainer_holds_is_tried_again(task: Task, held: int, starts: int, code: int) -> None:
    task.trainer(f"[ $(wc -l < started) -le {held} ] && exit 2\nexit 0")
    assert task.ends(task.start()) == code
    assert len(task.starts) == starts


@pytest.mark.parametrize(("number", "requeued"), [(signal.SIGTERM, []), (signal.SIGUSR1, ["requeue 42_1"])])
def test_a_signal_ends_the_waiting_for_a_held_run(task: Task, number: signal.Signals, requeued: list[str]) -> None:
    task.trainer("exit 2")
    task.program("sleep", "#!/bin/bash\ntouch waiting\nexec /bin/sleep 60\n")
    job = task.start()
    assert eventually(lambda: (task.folder / "waiting").exists())
    time.sleep(0.2)
    job.send_signal(number)
    assert task.ends(job) == (0 if requeued else 2)
    assert task.requeued == requeued
    assert len(task.starts) == 1


def test_a_folder_that_is_not_there_is_a_failure(task: Task) -> None:
    task.trainer("exit 0")
    task.folder.rmdir()
    assert task.ends(task.start()) == 1
