"""The HTTP interface against schemathesis: no request of any form makes the server fail or answer what it does not say.

Examples, boundary values, random values and sequences of requests, those that the schema allows and those it does not.
"""

import random
from typing import Any

import schemathesis
from schemathesis.config import SchemathesisConfig
from schemathesis.engine import events, from_schema

from tests.attack.outcome import Outcome
from tests.attack.target import TOKEN, Target, target
from tests.studio.conftest import add_checkpoint, make_run

_CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance",
    "response_headers_conformance",
)  # fmt: skip
_RUNS = tuple(f"20260101-00000{i}-reacher-morph-s{i}" for i in range(4))
_PATIENCE = 120.0
"""Seconds in which every request is answered, also on a machine that does other things."""


def attack_api(cases: int, seed: int, quiet: bool = False) -> Outcome:
    """Send at least so many cases to a real server whose trainers sleep."""
    outcome = Outcome("api", cases, "cases", seed, quiet=quiet)
    statuses: dict[int, int] = {}
    with target(asleep=True, MORPH_TRAINERS="2") as server:
        for name in _RUNS:
            add_checkpoint(make_run(server.runs, name), 3)
        began, round_ = server.megabytes(), 0
        while outcome.tried < cases and round_ < 100:
            _round(server, seed + round_, max(1, min(60, (cases - outcome.tried) // 100)), statuses, outcome)
            round_ += 1
        outcome.figures |= {
            "rounds": float(round_),
            "answers": ", ".join(f"{count} x {status}" for status, count in sorted(statuses.items())),
            "server MB": f"{began:.0f} to {server.megabytes():.0f}",
        }
        for error in server.errors():
            outcome.fault(f"a traceback in the server's log: {error}")
        if not server.serves_a_newcomer():
            outcome.fault("a browser that comes at the end is not served")
    return outcome.end()


def _round(server: Target, seed: int, examples: int, statuses: dict[int, int], outcome: Outcome) -> None:
    """Let schemathesis try all its phases once."""
    config = SchemathesisConfig.from_dict(
        {
            "seed": seed,
            "headers": {"Authorization": f"Bearer {TOKEN}"},
            "request-timeout": _PATIENCE,
            "max-stream-events": 1,  # the audience's stream has no end
            "continue-on-failure": True,
            "workers": 1,
            "generation": {"max-examples": examples, "no-shrink": True, "database": "none"},
            "phases": {"coverage": {"enabled": outcome.wanted >= 1000}},  # boundary values alone are a thousand
            "checks": {"enabled": False, **{name: {"enabled": True} for name in _CHECKS}},
        }
    )
    schema = schemathesis.openapi.from_url(
        f"{server.url}/openapi.json", config=config, headers={"Authorization": f"Bearer {TOKEN}"}
    )
    hook = _real_run(server, random.Random(seed))
    schemathesis.hook(hook)
    try:
        for event in from_schema(schema).execute():
            if isinstance(event, events.NonFatalError):  # of schemathesis: it reads no `prefixItems`
                outcome.figures["not to be checked"] = event.label
            if isinstance(event, events.ScenarioFinished):
                _count(event.recorder, statuses, outcome)
    finally:
        schemathesis.hooks.unregister(hook)


def _real_run(server: Target, rng: random.Random) -> Any:
    """Return what lets half of the requests about a run be about one that is there, and none wait for long."""

    def before_call(context: Any, case: Any, kwargs: dict[str, Any]) -> None:
        del context, kwargs
        if "run_id" in (case.path_parameters or {}) and rng.random() < 0.5:
            name = rng.choice(_RUNS)
            if not (server.runs / name / "run.json").exists():
                make_run(server.runs, name)
            case.path_parameters["run_id"] = name
        if case.path.endswith("/events"):
            case.query = {**(case.query or {}), "follow": "false"}
        if isinstance(case.body, dict) and isinstance(case.body.get("episodes"), int):
            case.body["episodes"] = min(case.body["episodes"], 8)  # how many there are is no matter of form
        if case.path.endswith("/news") and "wait" in (case.query or {}):
            case.query = {**case.query, "wait": rng.choice([0, 0.1, -1, "x", 1e9])}

    return before_call


def _count(recorder: Any, statuses: dict[int, int], outcome: Outcome) -> None:
    for case_id, interaction in recorder.interactions.items():
        outcome.add()
        request, response = interaction.request, interaction.response
        if response is None:
            outcome.fault(f"{request.method} {request.uri[:200]}: no answer within {_PATIENCE:.0f} s")
            continue
        statuses[response.status_code] = statuses.get(response.status_code, 0) + 1
        for check in recorder.checks.get(case_id, ()):
            if check.failure_info is not None:
                failure = check.failure_info.failure
                said = f"{failure.title}: {failure.message}".replace("\n", " ")[:300]
                outcome.fault(f"{request.method} {request.uri[:200]} = {response.status_code}: {said}")
