"""Make a recorded run that comes with the studio: `python tests/bench/record.py RUNS... --out studio/recorded`.

RUNS are run folders of one task with the same settings and other seeds. That of the lowest seed is recorded, whatever
it came to, and what the others came to is noted beside it. Of each event numbers are rounded, of the episodes those
arrays are kept that are played, and checkpoints are left out.
"""

import argparse
import shlex
import shutil
import sys
from pathlib import Path

import msgspec
import numpy as np

from morph_core.catalogue import make_method, make_task
from morph_core.config import flattened, recorded
from morph_core.history import History
from morph_core.protocol import AnyEvent, Evaluation, StateChanged, encode
from morph_core.run_folder import RunFolder, read_episode, write_episode
from studio.recordings import ABOUT, PREFIX, Origin

EPISODES = 24
"""Largest number of recorded episodes that are kept."""
DIGITS = 6
"""Significant digits of the numbers of events."""
STEP = 1e-4
"""Step in m and rad to which what is played is rounded."""
LISTED = 4
"""Largest number of other runs of which each is said what it came to."""
PLAYED = ("qpos", "phi", "success", "contact", "milestones/", "reward_terms/")
"""Arrays of an episode that are kept, or how their names begin."""


def rounded(value: object) -> object:
    """Return a JSON value with its numbers rounded, without what is null."""
    match value:
        case float():
            return float(f"{value:.{DIGITS}g}")
        case dict():
            return {name: rounded(content) for name, content in value.items() if content is not None}
        case list() | tuple():
            return [rounded(content) for content in value]
    return value


def played(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return what an episode needs to be played, rounded."""
    kept = {name: array for name, array in arrays.items() if name.startswith(PLAYED)}
    return {
        name: array if array.dtype == bool or name == "phi" else (np.round(array / STEP) * STEP).astype(np.float32)
        for name, array in kept.items()
    }


def spread(iterations: list[int], count: int) -> set[int]:
    """Return so many of the iterations, evenly spread, the first and the last among them."""
    places = np.linspace(0, len(iterations) - 1, min(count, len(iterations)))
    return {iterations[round(place)] for place in places}


def command_of(history: History) -> str:
    """Return the command that trains a run again."""
    record = history.record
    words = ["morph-studio", "train", record.task, "--method", record.method, "--seed", str(record.seed)]
    words += ["--env-steps", str(record.env_steps)] if record.env_steps else ["--iterations", str(record.iterations)]
    return shlex.join(words)


def settings_of(history: History) -> str:
    """Return in words how the settings of a run differ from the defaults of its method for its task."""
    record = history.record
    defaults = flattened(recorded(make_method(record.method, make_task(record.task, record.task_options))))
    asked = flattened(record.config)
    differing = [f"{name}={asked[name]}" for name in asked if asked[name] != defaults.get(name)]
    return f"other than the defaults: {', '.join(differing)}" if differing else "the defaults of its task"


def final_of(history: History) -> tuple[int, int]:
    """Return the successes of the last evaluation, and of how many episodes."""
    last = history.last_evaluation
    assert last is not None
    assert last.episodes, "the last evaluation does not say how many episodes it had"
    return round(last.sampled_success * last.episodes), last.episodes


def chosen_among(histories: list[History]) -> str:
    """Return the sentence on how the first of the runs was chosen, and what the others came to."""
    seeds = [history.record.seed for history in histories]
    if len(histories) == 1:
        return f"The only run that was trained for this, of seed {seeds[0]}."
    ends = [final_of(history) for history in histories[1:]]
    counts = [successes for successes, _ in ends]
    others = f"{min(counts)} to {max(counts)}" if len(counts) > LISTED else " and ".join(map(str, counts))
    of = {episodes for _, episodes in ends}
    assert len(of) == 1, "the last evaluations have different numbers of episodes"
    return (
        f"The one of the lowest of {len(histories)} seeds ({seeds[0]} to {seeds[-1]}), whatever it came to; the others "
        f"came to {others} of {of.pop()} successful episodes."
    )


def make(runs: list[Path], out: Path) -> Path:
    """Record the run of the lowest seed; return the folder of the recording."""
    histories = sorted((History(RunFolder(run)) for run in runs), key=lambda history: history.record.seed)
    history = histories[0]
    assert all(h.record.task == history.record.task for h in histories), "the runs are of several tasks"
    assert all(h.record.config == history.record.config for h in histories), "the runs have other settings"
    states = [event for event in history.events if isinstance(event, StateChanged)]
    assert [state.status for state in states] == ["starting", "running", "finished"], "the run was not left alone"
    name = f"{PREFIX}{history.record.task}"
    target = out / name
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    record = msgspec.structs.replace(history.record, id=name)
    (target / "run.json").write_bytes(msgspec.json.format(encode(record), indent=1))
    recorded_episodes = [e.iteration for e in history.evaluations if e.episode]
    kept = spread(recorded_episodes, EPISODES)
    with (target / "events.jsonl").open("wb") as log:
        for event in history.events:
            log.write(msgspec.json.encode(rounded(msgspec.to_builtins(without(event, kept)))) + b"\n")
    for iteration in sorted(kept):
        arrays = played(read_episode(history.folder, iteration))
        arrays["phi"] = np.array(rounded(arrays["phi"].tolist()))
        write_episode(RunFolder(target), iteration, arrays)
    successes, episodes = final_of(history)
    origin = Origin(
        run=history.folder.id,
        command=command_of(history),
        settings=settings_of(history),
        processor=f"{states[0].processor}, {states[0].instruction_set}",
        versions=history.record.versions,
        revision=history.record.git_revision or "",
        seconds=round(states[-1].time - states[0].time, 1),
        successes=successes,
        episodes=episodes,
        chosen=chosen_among(histories),
        kept=f"All {history.iteration} iterations, their numbers rounded to {DIGITS} digits; {len(kept)} of "
        f"{len(recorded_episodes)} recorded episodes, rounded to 0.1 mm and 0.1 mrad; no checkpoint.",
        made_by=f"python tests/bench/record.py {' '.join(h.folder.id for h in histories)} --out {out}",
    )
    (target / ABOUT).write_bytes(msgspec.json.format(msgspec.json.encode(origin), indent=1))
    return target


def without(event: AnyEvent, kept: set[int]) -> AnyEvent:
    """Return an event that names no episode which is left out."""
    if isinstance(event, Evaluation) and event.iteration not in kept:
        return msgspec.structs.replace(event, episode=None, recorded=[])
    return event


def main() -> None:
    """Record a run, and say how large the recording is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of one task and the same settings")
    parser.add_argument("--out", type=Path, default=Path("studio/recorded"))
    asked = parser.parse_args()
    target = make(asked.runs, asked.out)
    size = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
    print(f"{target}: {size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
