"""A stand-in for Slurm's commands: a cluster whose queue is a file, and which starts nothing.

It is put on PATH as sbatch, squeue, scancel and scontrol, and keeps what it was called with in `calls`.
"""

import json
import os
import re
import sys
from pathlib import Path

HERE = Path(os.environ["FAKE_SLURM"])
INVALID = "Invalid job id specified"


def main(name: str, words: list[str]) -> int:
    with (HERE / "calls").open("a") as calls:
        calls.write(
            json.dumps([name, words, {key: os.environ.get(key) for key in ("MORPH_TOKEN", "PYTHONPATH")}]) + "\n"
        )
    refusals = json.loads((HERE / "refusals").read_text())
    words_of_refusal = refusals[name].pop(0) if refusals.get(name) else None
    (HERE / "refusals").write_text(json.dumps(refusals))
    if words_of_refusal is not None:
        sys.stderr.write(words_of_refusal)
        return 1
    queue: dict[str, str] = json.loads((HERE / "queue").read_text())
    code = {"sbatch": sbatch, "squeue": squeue, "scancel": scancel, "scontrol": scontrol}[name](queue, words)
    (HERE / "queue").write_text(json.dumps(queue))
    return code


def sbatch(queue: dict[str, str], words: list[str]) -> int:
    if "--test-only" in words:
        return 0
    with (HERE / "jobs").open("a+") as jobs:
        jobs.seek(0)
        job = 42 + len(jobs.readlines())
        jobs.write(f"{job}\n")
    [last] = [re.fullmatch(r"--array=0-(\d+)%\d+", word)[1] for word in words if word.startswith("--array=")]
    queue.update({f"{job}_{i}": "PENDING||Priority" for i in range(int(last) + 1)})
    sys.stdout.write(f"{job};a_cluster")
    return 0


def squeue(queue: dict[str, str], words: list[str]) -> int:
    [jobs] = [word.removeprefix("--jobs=").split(",") for word in words if word.startswith("--jobs=")]
    lines = [f"{task}|{state}" for task, state in queue.items() if task.split("_")[0] in jobs]
    if not lines:
        sys.stderr.write(f"slurm_load_jobs error: {INVALID}")
        return 1
    sys.stdout.write("\n".join(lines))
    return 0


def scancel(queue: dict[str, str], words: list[str]) -> int:
    queue.update({task: "CANCELLED||None" for task in queue if task in words or task.split("_")[0] in words})
    return 0


def scontrol(queue: dict[str, str], words: list[str]) -> int:
    assert words[0] == "requeue"
    if words[1] not in queue:
        sys.stderr.write(f"{words[1]}: {INVALID}")
        return 1
    queue[words[1]] = "PENDING||BeginTime"
    return 0


sys.exit(main(Path(sys.argv[0]).name, sys.argv[1:]))
