"""JSON in and out: bodies decoded strictly, answers encoded, and both in the OpenAPI schema."""

import hashlib
from collections.abc import Callable, Coroutine, Sequence
from types import UnionType
from typing import Annotated, TypeVar, cast

import msgspec
from fastapi import Request, Response

from morph_core.protocol import Acknowledged, AnyCommand, AnyEvent, Evaluation, Parameter, Progress
from studio.audience import AudienceState
from studio.credentials import KEY
from studio.fields import Field
from studio.filming import FilmState, FilmWish
from studio.lines import Row, Summary
from studio.log import LogEntry
from studio.moments import Moment
from studio.negotiation import is_known
from studio.new_run import Number, StartRun
from studio.recordings import Origin
from studio.shelf.marks import Marks, MarksChange
from studio.shelf.traces import Overlay
from studio.shelf.trash import Trashed
from studio.viewer.view import Seen, View
from studio.what_if import SweepPoint, WhatIf, Wish

MAX_BODY = 1 << 20
"""Largest body of a request, in bytes."""
Body = TypeVar("Body")


class ResumeRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Wish to go on with a run that has ended."""

    further: Number | None = None
    """Number of iterations beyond the last recorded one; without it the run goes on to the planned number."""
    from_start: bool = False
    """Whether a run of which no checkpoint can be read any more begins anew, which gives up what it had learnt."""


class TaskInfo(msgspec.Struct, frozen=True):
    """A task and what can be chosen about it."""

    name: str
    title: str
    z_unit: str
    """Unit of the hardware's output, and so of the divergence; empty where each component has its own typical unit."""
    options: list[Field]
    parameters: list[Parameter]
    settings: dict[str, list[Field]]
    """The settings of each method, with the defaults that were found to work for this task."""


class PresetInfo(msgspec.Struct, frozen=True):
    """One word for a whole set of settings of a method."""

    name: str
    meaning: str
    method: str


class BrokenPlugin(msgspec.Struct, frozen=True):
    """A plug-in that is installed and can't be used."""

    group: str
    """Entry-point group of the plug-in, such as "morph.tasks"."""
    name: str
    package: str
    reason: str


class TaskList(msgspec.Struct, frozen=True):
    """Everything a form for a new run needs."""

    tasks: list[TaskInfo]
    methods: list[str]
    method_titles: dict[str, str]
    """Clause on what each method does, by its name."""
    presets: list[PresetInfo]
    broken: list[BrokenPlugin]
    """The plug-ins that are installed and can't be used."""


class Accepted(msgspec.Struct, frozen=True):
    """Answer to a command: the number under which it will be acknowledged as an event.

    It is 0 for a stop that took a run out of a cluster's queue, which no trainer acknowledges.
    """

    id: int


class RunState(Summary, frozen=True, kw_only=True):
    """One run in full; the fields after `git_dirty` are None where the run is unreadable."""

    task_options: dict[str, object] | None = None
    config: dict[str, object] | None = None
    parameters: list[Parameter] | None = None
    """Design parameters with the bounds and locks now in force."""
    phi: list[float] | None = None
    versions: dict[str, str] | None = None
    git_revision: str | None = None
    git_dirty: bool | None = None
    begins_at: int = 0
    """Iteration from which the run counts on; 0 but for a branch that goes on where its parent was."""
    children: tuple[str, ...] = ()
    """Names of the runs that were branched from this one, oldest first."""
    best: Evaluation | None = None
    last_seq: int = 0
    acknowledged: tuple[Acknowledged, ...] = ()
    """Last few answers of the trainer to commands."""


class Bulletin(msgspec.Struct, frozen=True):
    """What has changed since the mark that was sent, and the mark to send next."""

    boot: str
    """Word that changes with every start of the server."""
    mark: str
    is_new: bool
    runs: list[Summary]
    """Runs that are new or have changed."""
    ids: list[str] | None
    """Names of all runs in the order of the list where runs have come or gone; else None."""
    seen: Seen | None
    """What the browser shows whose key was sent."""


class Invite(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Wish to let spectators in."""

    presenter: Annotated[str, msgspec.Meta(pattern=f"^{KEY.pattern}$")] | None = None
    """Key of the browser that they watch; without it, the one that has been there longest."""


class Follow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whether a spectator's camera is the presenter's, or its own."""

    follows: bool


class Metrics(msgspec.Struct, frozen=True):
    """The traces of a run."""

    progress: list[Progress]
    evaluations: list[Evaluation]


class Design(msgspec.Struct, frozen=True):
    """One phi, in the order of `names`."""

    iteration: int
    phi: list[float]


class Designs(msgspec.Struct, frozen=True):
    """The evolution of phi; it begins with the initial design, whose iteration is 0 or that from which a branch counts
    on."""

    names: list[str]
    units: list[str]
    best: int
    latest: int
    designs: list[Design]


class ExportedFile(msgspec.Struct, frozen=True):
    """One file of an export; `size` is in bytes, before it is packed."""

    path: str
    size: int


class Comparison(msgspec.Struct, frozen=True):
    """One line of the proof that the files are one robot: the largest difference found, and what is allowed."""

    name: str
    passed: bool
    worst: float
    allowed: float
    detail: str


class Checked(msgspec.Struct, frozen=True):
    """An export that has passed its checks; `size` is that of the zip, in bytes."""

    name: str
    size: int
    files: list[ExportedFile]
    checks: list[Comparison]


class Purged(msgspec.Struct, frozen=True):
    """Answer to the wish to empty the trash: how many runs were removed for good."""

    runs: int


class Health(msgspec.Struct, frozen=True):
    """State of the server; `boot` changes with every start of it."""

    status: str
    boot: str


class RecordedRun(msgspec.Struct, frozen=True, kw_only=True):
    """A recorded run that comes with the studio; only `run` and `problem` are there where it can't be read."""

    run: str
    """Name under which it is opened like any run."""
    task: str = ""
    method: str = ""
    seed: int | None = None
    label: str = ""
    """Words that stand wherever the run is seen."""
    origin: Origin | None = None
    """Where it comes from, and how it was chosen."""
    problem: str = ""


class Refusal(msgspec.Struct, frozen=True):
    """Answer to a request that is refused: a sentence that says what is allowed."""

    detail: str


def body_of(kind: type[Body] | UnionType) -> Callable[[Request], Coroutine[None, None, Body]]:
    """Return a dependency that decodes the request's body; it raises ValueError on anything but a whole `kind`.

    JSON knows no NaN or infinity, and numbers beyond a float's range are refused by the decoder.
    """
    decoder = msgspec.json.Decoder(kind)

    async def decode(request: Request) -> Body:
        try:
            return cast(Body, decoder.decode(await request.body() or b"{}"))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ValueError(f"this body can't be used: {error}") from error

    return decode


def sender_of(request: Request) -> str:
    """Return words on who sent a request, for the log of a run."""
    return f"API, {request.client.host}" if request.client else "API"


def reply(message: object, status: int = 200) -> Response:
    """Return the message as JSON."""
    return Response(msgspec.json.encode(message), status, media_type="application/json")


def versioned(answer: Response, known: Sequence[str] | None) -> Response:
    """Return an answer with its version as ETag, or only that it has not changed where If-None-Match has it already."""
    version = f'"{hashlib.sha256(answer.body).hexdigest()[:32]}"'
    if is_known(version, known or ()):
        answer = Response(status_code=304)
    answer.headers["ETag"] = version
    return answer


_KINDS = (
    StartRun, ResumeRun, TaskList, Accepted, Summary, RunState, LogEntry, Moment, Metrics, Designs, Checked, Health,
    Refusal, AnyCommand, AnyEvent, Wish, WhatIf, SweepPoint, Row, Marks, MarksChange, Trashed, Purged, Overlay,
    View, Seen, Bulletin, RecordedRun, AudienceState, Invite, Follow, FilmWish, FilmState,
)  # fmt: skip
_REF = "#/components/schemas/{name}"


def _anything(kind: object) -> dict[str, object]:
    """Return the schema of `object`, which msgspec leaves open."""
    if kind is not object:
        raise NotImplementedError(f"{kind} has no schema")
    return {"description": "Any JSON value; checked by the config and the task"}


def schemas() -> dict[str, object]:
    """Return the OpenAPI components of all messages."""
    return msgspec.json.schema_components(_KINDS, schema_hook=_anything, ref_template=_REF)[1]


def schema(kind: object) -> dict[str, object]:
    """Return the OpenAPI reference to a message."""
    return msgspec.json.schema_components((kind,), schema_hook=_anything, ref_template=_REF)[0][0]


def takes(kind: object, required: bool = True) -> dict[str, object]:
    """Return the `openapi_extra` of a route with this body."""
    return {"requestBody": {"required": required, "content": {"application/json": {"schema": schema(kind)}}}}


def gives(kind: object, status: int = 200, description: str = "The answer") -> dict[int | str, dict[str, object]]:
    """Return the `responses` of a route with this answer."""
    answer = {"description": description, "content": {"application/json": {"schema": schema(kind)}}}
    return {status: answer, **REFUSALS}


def gives_versioned(kind: object) -> dict[int | str, dict[str, object]]:
    """Return the `responses` of a route whose answer is `versioned`."""
    return {304: {"description": "It is as If-None-Match has it already"}, **gives(kind)}


def gives_file(media_type: str, description: str) -> dict[int | str, dict[str, object]]:
    """Return the `responses` of a route that answers with a file or stream."""
    one_text = media_type != "text/event-stream"  # whose events have a schema each, for which OpenAPI 3.1 has no word
    content: dict[str, object] = {"schema": {"type": "string"}} if one_text else {}
    return {200: {"description": description, "content": {media_type: content}}, **REFUSALS}


REFUSALS: dict[int | str, dict[str, object]] = {
    status: {"description": text, "content": {"application/json": {"schema": schema(Refusal)}}}
    for status, text in {
        401: "No token",
        429: "Too many wrong tokens",
        403: "Wrong Host or Origin",
        404: "No such run, design or file",
        413: "A body that is too long",
        422: "A value that is not allowed",
        503: "The disk refuses, the process that evaluates designs has died, or too much work waits already",
    }.items()
}
