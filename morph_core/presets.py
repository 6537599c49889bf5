"""Presets: one word for a whole set of settings of a method."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from morph_core.config import flattened
from morph_core.task import Task

DEFAULT_METHOD = "morph"


@dataclass(frozen=True)
class Preset:
    """Settings of a method that belong together, under one word."""

    name: str
    meaning: str
    """Sentence for people on what the preset is."""
    method: str
    settings: Mapping[str, object] = field(default_factory=dict)
    """Settings that differ from those that were found to work for the task, under dotted names."""
    where_no_proxy_world: Mapping[str, object] = field(default_factory=dict)
    """Settings in place of those, for a task that can't be simulated in the proxy's world."""

    def settings_for(self, task: Task | None) -> dict[str, object]:
        """Return the settings of the preset for a task, or for any that can be simulated in the proxy's world, under
        dotted names."""
        return dict(self.settings) | ({} if task is None or task.runs_on_proxy else dict(self.where_no_proxy_world))


PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset(
            "studio",
            "Today's defaults: designs around φ are tried on Hw-Phy, no gradient is projected.",
            "morph",
        ),
        Preset(
            "paper",
            "Algorithm 1 with CMA-ES: trajectories in the proxy's world, projection (of the hands: neither).",
            "morph",
            # phi has to be frozen on success: among episodes that all succeed, ranking moves it at random.
            {"exploration": "gaussian", "search": "cma", "projection": "one_sided", "freeze_success": 0.8},
            {
                "exploration": "design",
                # Contact's own variance would draw CMA-ES to a hand that touches nothing; docs/hands.md has the runs.
                "search": "cma_debiased",
                # K and kappa were chosen with it: a search costs as many steps as four iterations.
                "design_interval": 4,
                "exploration.kappa": 3.0,
                "freeze_success": 0.5,
                "projection": "none",  # with one_sided a hand lost again what it had learned
            },
        ),
    )
}


def preset_named(name: str) -> Preset:
    """Return a preset; ValueError lists the choices."""
    if name not in PRESETS:
        raise ValueError(f'unknown preset "{name[:40]}"; choose from: {", ".join(PRESETS)}')
    return PRESETS[name]


def method_of(preset: str | None) -> str:
    """Return the method of a preset, or the usual one without; ValueError lists the presets."""
    return preset_named(preset).method if preset is not None else DEFAULT_METHOD


def with_preset(
    preset: str | None, method: str, task: Task | None, settings: Mapping[str, object]
) -> dict[str, object]:
    """Return settings under dotted names: those of the preset with `settings` on top.

    Where `settings` choose another exploration or search than the preset, what the preset says of that part is left
    out. Raise ValueError for an unknown preset, or one of another method than `method`.
    """
    asked = flattened(dict(settings))
    if preset is None:
        return asked
    chosen = preset_named(preset)
    if method != chosen.method:
        raise ValueError(f"the preset {preset} is one of the method {chosen.method}, not of {method}: leave one out")
    own = chosen.settings_for(task)
    replaced = [f"{name}." for name, value in asked.items() if name in own and own[name] != value]
    return {name: value for name, value in own.items() if not name.startswith(tuple(replaced))} | asked
