"""The wire: what trainer and studio tell each other, as files of the run folder and as the API's schema.

Event = kept, in order. Snapshot = may be replaced by a newer one. Command = from a user to the trainer.
"""

from typing import Annotated, Literal, get_args

import msgspec

from morph_core.config import LARGEST, Projection
from morph_core.hypertext import table

Whole = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
"""A number of something: browsers hold no larger ones, and nothing is counted below zero."""
Measure = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
"""A value of a design parameter in its unit: no robot has larger ones."""
Rate = Annotated[float, msgspec.Meta(ge=0, le=1)]
"""A share of episodes."""
Real = Annotated[float, msgspec.Meta(ge=-1e100, le=1e100)]
"""A number that was measured: sums and squares of such numbers are finite, and no single-precision number is larger."""
Moment = Annotated[float, msgspec.Meta(ge=0, le=2.5e11)]
"""A time in seconds since the epoch, before the year 10000: calendars have no later ones."""

Status = Literal[
    "queued", "starting", "running", "pausing", "paused", "stopped", "finished", "failed", "lost", "unreadable"
]
"""`queued`, `lost` and `unreadable` are a reader's verdicts; a trainer never writes them."""


class Parameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One design parameter; all numbers in `unit`."""

    name: str
    unit: str
    lo: Measure
    hi: Measure
    initial: Measure
    hard_lo: Measure
    """Lower end of the task's own box, inside which `lo` and `hi` may be edited."""
    hard_hi: Measure
    scale: Measure = 1.0
    """Typical change of the parameter: the unit of exploration and of the search's sigma0."""
    locked_at: Measure | None = None
    group: str = ""
    """Name of the group of parameters that share part of their noise when designs are explored; empty for none."""
    part: str = ""
    """Part of the robot that the parameter belongs to, as the names of its bodies and geoms begin; empty for none."""


# --- Commands ---------------------------------------------------------------------------------------------------------


class Command(msgspec.Struct, frozen=True, tag_field="type", forbid_unknown_fields=True):
    """Base of all commands; applied between two iterations and acknowledged with the iteration."""


class Pause(Command, tag="pause", frozen=True):
    """Hold after the present iteration."""


class Resume(Command, tag="resume", frozen=True):
    """Go on after a pause."""


class StepIteration(Command, tag="step", frozen=True):
    """Run one iteration, then hold."""


class Stop(Command, tag="stop", frozen=True):
    """Save a checkpoint and end the trainer; the run can be resumed."""


class Kill(Command, tag="kill", frozen=True):
    """End the trainer at once, without a checkpoint: what came after the newest one is done again at a resume.

    The studio on the trainer's machine does it; a trainer is never asked.
    """


class Checkpoint(Command, tag="checkpoint", frozen=True):
    """Save a checkpoint now."""


class SetAlpha(Command, tag="set_alpha", frozen=True):
    """Set alpha, the weight of the divergence (>= 0)."""

    alpha: float


class SetProjection(Command, tag="set_projection", frozen=True):
    """Set the projection rule."""

    projection: Projection


class SetBound(Command, tag="set_bound", frozen=True):
    """Set the bounds of one design parameter; lo < hi, inside the task's hard box."""

    name: str
    lo: float
    hi: float


class Lock(Command, tag="lock", frozen=True):
    """Hold one design parameter at `value`, or at its present value."""

    name: str
    value: float | None = None


class Unlock(Command, tag="unlock", frozen=True):
    """Free one design parameter."""

    name: str


class InjectDesign(Command, tag="inject_design", frozen=True):
    """Continue from this phi, in the order of the design space."""

    phi: list[Measure]


AnyCommand = (
    Pause
    | Resume
    | StepIteration
    | Stop
    | Kill
    | Checkpoint
    | SetAlpha
    | SetProjection
    | SetBound
    | Lock
    | Unlock
    | InjectDesign
)


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A command in the inbox, under the number by which it will be acknowledged."""

    id: Whole
    command: AnyCommand
    sender: str = ""
    """Words on who sent it and by which way, where that is known."""


# --- Events -----------------------------------------------------------------------------------------------------------


class Event(msgspec.Struct, frozen=True, tag_field="kind", kw_only=True):
    """Base of all events; `seq` rises by one within a run, `time` is seconds since the epoch."""

    seq: Whole = 0
    time: Moment = 0.0


class StateChanged(Event, tag="state", frozen=True):
    """The trainer entered `status`. After `starting`, progress beyond `iteration` is void (a resume rewinds)."""

    status: Status
    iteration: Whole
    message: str = ""
    processor: str = ""
    """Model of the processor on which the trainer starts; with another one, results may differ in their last bits."""
    instruction_set: str = ""
    """Instruction set that torch takes on it, such as AVX2 or AVX512."""


class Progress(Event, tag="progress", frozen=True):
    """One iteration of a method. A metric that is not defined in this iteration or method is None."""

    iteration: Whole
    env_steps: Whole
    """Environment steps so far, on Hw-Phy and in the proxy's world alike."""
    phi: list[Measure]
    episode_return: Real
    """Mean undiscounted return of the iteration's trajectories, over the designs that were explored."""
    success: Rate
    """Share of the iteration's trajectories that reached the goal."""
    policy_std: Real
    design_sigma: Real | None = None
    divergence: Real | None = None
    """D: mean squared distance of Hw-Phy with the present phi and the proxy on sampled (s, a)."""
    search_cost: Real | None = None
    """Divergence of Hw-Phy from the dataset after the search for phi."""
    cosine: Real | None = None
    """S_c: mean cosine of g_task and g_hw over psi."""
    cosine_negative: Real | None = None
    """Share of this iteration's gradient steps with a negative cosine."""
    cosine_by_parameter: list[Real | None] | None = None
    """Mean cosine of both gradients along the direction in which each design parameter moves z; None where Hw-Phy is
    not differentiable."""
    alpha: Real | None = None
    projection: Projection | None = None
    frozen: bool = False
    """Whether phi stays as it is from here on, because episodes succeed often enough."""
    control_start: Whole = 0
    """The iteration after which policy and critic last started afresh; 0 for the first weights."""
    relabelled_steps: Whole = 0
    """Steps of Hw-Phy so far outside of trajectories and of the search for phi: fitting the proxy, relabelling, and
    what an exploration asks of designs. A run from before `search_steps` were told apart counts them here."""
    search_steps: Whole = 0
    """Steps of Hw-Phy so far that the search for phi took."""
    diverged: Whole = 0
    """Episodes so far that were left out because their simulation diverged."""
    cpu_seconds: Real = 0.0
    """CPU time of the trainer since its first iteration, all resumes summed."""

    def _repr_html_(self) -> str:
        """Return the iteration as an HTML table, without what was not measured in it."""
        measured = [
            ("environment steps", f"{self.env_steps:,}"),
            ("success in training", f"{self.success:.0%} of episodes"),
            ("return in training", f"{self.episode_return:.4g}"),
            ("divergence D", _known(self.divergence)),
            ("search cost", _known(self.search_cost)),
            ("cosine of g_task, g_hw", _known(self.cosine)),
            ("α", _known(self.alpha)),
            ("projection", self.projection or ""),
            ("φ", ", ".join(f"{value:.4g}" for value in self.phi)),
            ("CPU time", f"{self.cpu_seconds:.0f} s"),
        ]
        return table((), ((name, value) for name, value in measured if value), f"Iteration {self.iteration}")


def _known(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


Which = Literal["median", "best", "worst", "failed"]
"""Episodes of an evaluation that are recorded, by their return; of the failed ones, the one in the middle."""
EPISODES: tuple[Which, ...] = get_args(Which)


class Recorded(msgspec.Struct, frozen=True):
    """What one of the recorded episodes came to."""

    which: Which
    episode_return: Real
    success: bool


class Evaluation(Event, tag="evaluation", frozen=True):
    """The policy on Hw-Phy with the present phi. `episode` names the file of its episodes, relative to the run."""

    iteration: Whole
    env_steps: Whole
    phi: list[Measure]
    sampled_success: Rate
    sampled_return: Real
    deterministic_success: Rate
    deterministic_return: Real
    milestones: dict[str, Rate] = {}
    """Shares of the sampled episodes that reached each milestone before the goal, by the rule of success."""
    diverged: Whole = 0
    """Sampled episodes whose simulation diverged: they count as failures."""
    episode: str | None = None
    recorded: list[Recorded] = []
    """Episodes that the file holds; empty where it holds a single one, as those of earlier versions do."""
    reward_terms: dict[str, Real] = {}
    """Terms of the reward, summed over a sampled episode: their means, which add up to the return."""
    return_interval: tuple[Real, Real] | None = None
    """Interval of the mean return of the sampled policy, at 95 %; None in a run that did not write it down."""
    cpu_seconds: Real = 0.0
    episodes: Whole | None = None
    """Number of episodes of each kind, sampled and deterministic; None in a run that did not write it down."""
    final: bool = False
    """Whether this is the evaluation at the end of the run, over its `final_episodes`."""

    def _repr_html_(self) -> str:
        """Return the evaluation as an HTML table: the policy as it explores, and by its mean action."""
        rows = [
            ("success [% of episodes]", f"{100 * self.sampled_success:.3g}", f"{100 * self.deterministic_success:.3g}"),
            ("return [reward]", f"{self.sampled_return:.4g}", f"{self.deterministic_return:.4g}"),
            *((f"{name} [% of episodes]", f"{100 * share:.3g}", "") for name, share in self.milestones.items()),
        ]
        number = "" if self.episodes is None else f", {self.episodes} episodes of each kind"
        return table(["policy", "sampled", "mean action"], rows, f"Evaluation after iteration {self.iteration}{number}")


class Acknowledged(Event, tag="command", frozen=True):
    """The trainer took a command: `accepted` and in force from `iteration` + 1 on, or refused with the reason."""

    id: Whole
    iteration: Whole
    accepted: bool
    command: AnyCommand
    message: str = ""
    sender: str = ""
    """Words on who sent the command and by which way, where that is known."""


class DesignSpaceChanged(Event, tag="design_space", frozen=True):
    """The bounds or locks now in force."""

    iteration: Whole
    parameters: list[Parameter]


AnyEvent = StateChanged | Progress | Evaluation | Acknowledged | DesignSpaceChanged


# --- Snapshots and records --------------------------------------------------------------------------------------------

FORMAT = 2
"""The newest format of run.json that this version knows, and the one that it writes."""


class Heartbeat(msgspec.Struct, frozen=True):
    """What the trainer does right now; rewritten every second."""

    host: str
    pid: int
    """Number of the trainer's process on `host`."""
    process_started: Moment
    """Start time of the trainer's process (seconds since the epoch), so that a reused pid is not taken for it."""
    time: Moment
    status: Status
    stage: str
    """Words for what is done: "loading", "fitting the proxy", "collecting and learning", "evaluating", "saving"."""
    iteration: Whole
    iterations: Whole
    """Iterations after which the run ends, estimated where its budget of environment steps ends it sooner."""
    env_steps: Whole = 0
    eta_seconds: Real | None = None
    message: str = ""


class Parent(msgspec.Struct, frozen=True):
    """The run and iteration that a run was branched from, or whose design it began with."""

    run: str
    iteration: Whole
    checkpoint: Whole | None = None
    """Iteration of the checkpoint that a branch took along: the nearest up to `iteration`; None for a run that took
    only a design."""


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Content of run.json, which is written once: everything that is needed to run it again."""

    format: Whole = 1
    """Format of run.json: 1 has the settings as one flat list, 2 nested by part."""
    id: str
    task: str
    task_options: dict[str, object] = {}
    """Fields of the task's own dataclass that differ from its defaults (reacher: tunnel, z, ...)."""
    method: str
    seed: Whole
    iterations: Whole
    env_steps: Whole | None = None
    """Budget of environment steps: the run ends after the iteration that reaches it, or after `iterations`."""
    final_episodes: Whole = 0
    """Episodes of each kind, sampled and deterministic, in the evaluation at the end of the run; 0 for none."""
    config: dict[str, object]
    parameters: list[Parameter]
    versions: dict[str, str]
    git_revision: str | None = None
    git_dirty: bool | None = None
    created: Moment
    parent: Parent | None = None
    begins_at: Whole = 0
    """Iteration from which the run counts on: that of the checkpoint which a branch with its parent's method took."""


class _Format(msgspec.Struct, frozen=True):
    """What any format of run.json says of itself."""

    format: Whole = 1


_encoder = msgspec.json.Encoder()
_FORMAT_1 = {"truncations": "diverged", "rollout": "episode"}
"""Fields of events as format 1 of a run called them -> as they are called now."""
_TRUNCATIONS, _ROLLOUT = (f'"{name}":'.encode() for name in _FORMAT_1)
_events = msgspec.json.Decoder(AnyEvent)
_orders = msgspec.json.Decoder(Order)
_records = msgspec.json.Decoder(RunRecord)
_formats = msgspec.json.Decoder(_Format)
_heartbeats = msgspec.json.Decoder(Heartbeat)


def encode(message: msgspec.Struct) -> bytes:
    """Return one line of JSON. NaN and infinities become null: keep them out of required fields."""
    return _encoder.encode(message)


def decode_event(line: bytes | str) -> AnyEvent:
    """Return an event, of a run of format 1 too; msgspec.DecodeError (ValidationError) on anything else."""
    written = line.encode() if isinstance(line, str) else line
    if _TRUNCATIONS not in written and _ROLLOUT not in written:
        return _events.decode(written)
    fields = msgspec.json.decode(written, type=dict[str, object])
    return msgspec.convert({_FORMAT_1.get(name, name): value for name, value in fields.items()}, AnyEvent)


def decode_order(text: bytes | str) -> Order:
    """Return an order; raise msgspec.DecodeError (ValidationError) on anything else."""
    return _orders.decode(text)


def decode_record(text: bytes | str) -> RunRecord:
    """Return the content of a run.json; raise msgspec.DecodeError (ValidationError) on anything else."""
    return _records.decode(text)


def format_of(text: bytes | str) -> int:
    """Return the format of a run.json, whatever else that format holds; msgspec.DecodeError on anything else."""
    return _formats.decode(text).format


def decode_heartbeat(text: bytes | str) -> Heartbeat:
    """Return a heartbeat; raise msgspec.DecodeError (ValidationError) on anything else."""
    return _heartbeats.decode(text)
