"""What a policy came to on a changed body, beside what it came to on the recorded one: a table as HTML."""

from studio.viewer import wording
from studio.what_if import WhatIf

_CELL = "text-align:right;vertical-align:top;padding-left:0.8em;font-variant-numeric:tabular-nums"
_TABLE = "width:97%;border-collapse:collapse;line-height:1.3"


def outcome_table(found: WhatIf, before: WhatIf | None) -> str:
    """Return the table; without a second column where `before` is None."""
    columns = [found] if before is None else [found, before]
    lines = [
        ("<b>success</b>", [f"<b>{wording.percent(m.success)}</b> {_shares(m.success_interval)}" for m in columns]),
        *((wording.text(name), [wording.percent(m.milestones[name]) for m in columns]) for name in found.milestones),
        ("return", [f"{_number(m.episode_return)} {_numbers(m.return_interval)}" for m in columns]),
        *((f"&ensp;{_words(name)}", [_number(m.reward_terms[name]) for m in columns]) for name in found.reward_terms),
    ]
    if any(m.diverged for m in columns):
        lines.append(("diverged", [f"{m.diverged} of {m.episodes}" for m in columns]))
    rows = [_row(name, cells) for name, cells in lines]
    if before is not None:
        rows.insert(0, _row("", ["this body", "recorded body"]))
    said = f"{found.episodes} episodes on Hw-Phy, {found.policy} policy; [intervals] at 95 %"
    note = f"<br>{wording.text(found.note)}" if found.note else ""
    return wording.paragraph(f'<table style="{_TABLE}">{"".join(rows)}</table>{wording.dim(said + note)}')


def _row(name: str, cells: list[str]) -> str:
    return "".join(
        [f'<tr><td style="opacity:0.75">{name}</td>', *(f'<td style="{_CELL}">{c}</td>' for c in cells), "</tr>"]
    )


def _shares(interval: tuple[float, float]) -> str:
    lo, hi = interval
    return wording.dim(f"[{100 * lo:.0f}, {100 * hi:.0f}]")


def _numbers(interval: tuple[float, float]) -> str:
    return wording.dim(f"[{', '.join(map(_number, interval))}]")


def _words(name: str) -> str:
    return wording.text(name.replace("_", " "))


def _number(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")
