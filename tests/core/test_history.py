"""What was in force when: bounds, locks, phi, alpha and projection, from the log alone."""

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.catalogue import make_task
from morph_core.edits import edited
from morph_core.history import History, InForce
from morph_core.protocol import (
    Acknowledged,
    AnyCommand,
    AnyEvent,
    DesignSpaceChanged,
    InjectDesign,
    Lock,
    Progress,
    SetAlpha,
    SetBound,
    SetProjection,
    StateChanged,
    Unlock,
)
from morph_core.run_folder import EventLog, RunFolder
from tests.core.conftest import make_run

TASK = make_task("reacher")
SPACE = TASK.design_space


def write(folder: RunFolder, *events: AnyEvent) -> History:
    log = EventLog(folder)
    for event in events:
        log.append(event)
    log.close()
    return History(folder)


def progress(iteration: int, phi: float = 3.0, alpha: float | None = None) -> Progress:
    return Progress(
        iteration=iteration, env_steps=9, phi=[phi] * 5, episode_return=0, success=0, policy_std=0.5, alpha=alpha
    )


def obeyed(iteration: int, command: AnyCommand, accepted: bool = True) -> Acknowledged:
    return Acknowledged(id=1, iteration=iteration, accepted=accepted, command=command)


def facts(in_force: InForce) -> tuple[object, ...]:
    return in_force.space, in_force.phi.tolist(), in_force.alpha, in_force.projection


# --- a trainer in miniature: what it holds is what the log must say ---------------------------------------------------


@dataclasses.dataclass
class Miniature:
    """Iterates, obeys and saves as the trainer does, but learns nothing; remembers what was in force when."""

    log: EventLog
    records_alpha: bool
    now: InForce = dataclasses.field(default_factory=lambda: InForce(SPACE, SPACE.initial, 1.0, "none"))
    iteration: int = 0
    began: dict[int, InForce] = dataclasses.field(default_factory=dict)
    saved: tuple[int, InForce, dict[int, InForce]] | None = None

    def save(self) -> None:
        self.saved = self.iteration, self.now, dict(self.began)

    def iterate(self, by: float) -> None:
        self.iteration += 1
        self.began[self.iteration] = self.now
        phi = self.now.space.clip(self.now.phi + by)
        self.now = dataclasses.replace(self.now, phi=phi)
        self.log.append(
            Progress(
                iteration=self.iteration, env_steps=9, phi=phi.tolist(), episode_return=0, success=0, policy_std=0.5,
                alpha=self.now.alpha if self.records_alpha else None,
                projection=self.now.projection if self.records_alpha else None,
            )
        )  # fmt: skip

    def obey(self, command: AnyCommand) -> None:
        space, accepted = self.now.space, True
        try:
            self.now = edited(TASK, self.now, command).in_force  # pyright: ignore[reportArgumentType]
            self.save()
        except ValueError:
            accepted = False
        if self.now.space != space:
            self._tell_space()
        self.log.append(obeyed(self.iteration, command, accepted))

    def die_and_resume(self) -> None:
        assert self.saved
        self.iteration, self.now, began = self.saved
        self.began = dict(began)
        self.log.append(StateChanged(status="starting", iteration=self.iteration))
        self._tell_space()

    def _tell_space(self) -> None:
        self.log.append(DesignSpaceChanged(iteration=self.iteration, parameters=list(self.now.space.parameters)))


values = st.floats(0.05, 5.0)
names = st.sampled_from(SPACE.names[:2])
commands = st.one_of(
    st.builds(SetAlpha, st.floats(-1, 9)),
    st.builds(SetProjection, st.sampled_from(["none", "one_sided"])),
    st.builds(SetBound, names, values, values),
    st.builds(Lock, names, st.none() | values),
    st.builds(Unlock, names),
    st.builds(InjectDesign, st.lists(values, min_size=5, max_size=5)),
)
steps = st.lists(commands | st.floats(-0.5, 0.5) | st.sampled_from(["save", "die"]), max_size=25)


@settings(max_examples=150, deadline=None)
@given(steps=steps, records_alpha=st.booleans())
def test_the_log_says_what_was_in_force_in_every_iteration_that_counts(
    steps: list[AnyCommand | float | str], records_alpha: bool
) -> None:
    with tempfile.TemporaryDirectory() as runs:
        folder = make_run(Path(runs))
        history, log = History(folder), EventLog(folder)
        trainer = Miniature(log, records_alpha)
        trainer.save()
        for step in steps:
            match step:
                case "save":
                    trainer.save()
                case "die":
                    trainer.die_and_resume()
                case float():
                    trainer.iterate(step)
                case command:
                    trainer.obey(command)  # pyright: ignore[reportArgumentType]
            history.poll()
            assert facts(history.in_force) == facts(trainer.now)
        assert {i: facts(history.at(i)) for i in trainer.began} == {i: facts(f) for i, f in trainer.began.items()}
        assert facts(History(folder).at()) == facts(trainer.now)
        log.close()


# --- one thing at a time ----------------------------------------------------------------------------------------------


def test_before_anything_happened_the_record_is_in_force(tmp_path: Path) -> None:
    history = History(make_run(tmp_path))
    assert facts(history.in_force) == facts(history.at(0)) == (SPACE, [3.0] * 5, 1.0, "none")


def test_an_iteration_says_what_it_ran_with_and_later_commands_change_it(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    assert write(folder, obeyed(0, SetAlpha(4.0)), progress(1, alpha=9.0)).in_force.alpha == 9.0
    assert write(folder, obeyed(1, SetAlpha(5.0))).in_force.alpha == 5.0
    history = write(folder, progress(2, alpha=5.0), obeyed(2, SetAlpha(6.0)), obeyed(2, SetAlpha(7.0), accepted=False))
    assert [history.at(i).alpha for i in (0, 1, 2, 3)] == [1.0, 4.0, 5.0, 6.0]


def test_a_method_that_records_no_alpha_keeps_what_was_commanded(tmp_path: Path) -> None:
    history = write(
        make_run(tmp_path), obeyed(0, SetAlpha(4.0)), obeyed(0, SetProjection("one_sided")), progress(1), progress(2)
    )
    assert (history.in_force.alpha, history.in_force.projection) == (4.0, "one_sided")


def test_phi_is_where_commands_have_put_it_since_the_last_iteration(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    assert write(folder, obeyed(0, InjectDesign([1.0] * 5)), progress(1, phi=2.0)).in_force.phi.tolist() == [2.0] * 5
    assert write(folder, obeyed(1, InjectDesign([4.0] * 5))).in_force.phi.tolist() == [4.0] * 5
    narrow = DesignSpaceChanged(iteration=1, parameters=list(SPACE.with_bound("link_1", 1.0, 1.5).parameters))
    assert write(folder, narrow).in_force.phi.tolist() == [1.5, 4.0, 4.0, 4.0, 4.0]


@pytest.mark.parametrize("kept", [True, False])
def test_a_resume_voids_what_came_after_its_checkpoint(tmp_path: Path, kept: bool) -> None:
    narrow = SPACE.with_bound("link_1", 1.0, 2.0)
    history = write(
        make_run(tmp_path), progress(1), progress(2),
        DesignSpaceChanged(iteration=2, parameters=list(narrow.parameters)), obeyed(2, SetBound("link_1", 1.0, 2.0)),
        obeyed(2, SetAlpha(4.0)), progress(3), StateChanged(status="starting", iteration=2 if kept else 1),
    )  # fmt: skip
    assert facts(history.in_force) == (
        (narrow, [2.0, 3.0, 3.0, 3.0, 3.0], 4.0, "none") if kept else (SPACE, [3.0] * 5, 1.0, "none")
    )
    assert [c.command for c in history.commands()] == ([SetBound("link_1", 1.0, 2.0), SetAlpha(4.0)] if kept else [])


@pytest.mark.parametrize("written", ['"beta": 1.0', '"alpha": "much"', '"alpha": null', '"alpha": [1.0]'])
def test_a_record_without_a_number_to_steer_by_steers_nothing(tmp_path: Path, written: str) -> None:
    folder = make_run(tmp_path)
    path = folder.path / "run.json"
    path.write_text(path.read_text().replace('"alpha": 1.0', written))
    assert History(folder).in_force.alpha == 0.0
    assert np.array_equal(History(folder).in_force.phi, SPACE.initial)


@pytest.mark.parametrize(
    ("starts", "said"),
    [
        ([("EPYC 1", "AVX2"), ("EPYC 1", "AVX2")], ""),
        ([("", ""), ("EPYC 1", "AVX2")], ""),  # begun by a version that did not record it
        (
            [("EPYC 1", "AVX2"), ("Xeon 5", "AVX512")],
            "begun on EPYC 1, AVX2, went on from iteration 1 on Xeon 5, AVX512",
        ),
        ([("EPYC 1", "AVX2"), ("EPYC 1", "DEFAULT")], "begun on EPYC 1, AVX2, went on from iteration 1 on EPYC 1, DEF"),
        ([("A", "AVX2"), ("B", "AVX2"), ("B", "AVX2")], "begun on A, AVX2, went on from iteration 1 on B, AVX2"),
    ],
)
def test_another_kind_of_processor_is_warned_about(tmp_path: Path, starts: list[tuple[str, str]], said: str) -> None:
    history = write(
        make_run(tmp_path),
        *(
            StateChanged(status="starting", iteration=i, processor=processor, instruction_set=instructions)
            for i, (processor, instructions) in enumerate(starts)
        ),
    )
    assert history.other_processor.startswith(said)
    assert bool(history.other_processor) is bool(said)
