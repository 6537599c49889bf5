"""What a person does with the what-if panel in a browser."""

import pytest
from playwright.sync_api import Frame, Locator, Page, expect
from served import Server, beat_of, events_of, wait_for
from test_studio import open_studio, press, start_run, turn_to

from morph_core.protocol import Acknowledged, InjectDesign

pytestmark = pytest.mark.browser


def number_beside(frame: Frame, label: str) -> Locator:
    """Return the input beside a slider."""
    row = frame.get_by_text(label, exact=True).first.locator("xpath=ancestor::div[contains(@class, 'Flex-root')][1]")
    return row.locator("input:visible")


def sizes_of(frame: Frame) -> list[float]:
    """Return the sizes of the robot's parts as the browser's scene holds them."""
    script = """() => {
        const nodes = window.__viserSceneTree?.getState() ?? {}, found = [];
        for (const name of Object.keys(nodes).sort()) {
            const props = name.startsWith('/robot/') && nodes[name]?.message.props;
            if (props?.batched_scales) found.push(...Array.from(new Uint8Array(props.batched_scales.buffer)));
        }
        return found;
    }"""
    return frame.evaluate(script)


def test_a_person_changes_the_body_by_hand_and_goes_on_from_it(server: Server, page: Page) -> None:
    frame = open_studio(page, server)
    run = start_run(server, frame)
    press(frame, "Pause")
    wait_for("the pause", lambda: beat_of(run).status == "paused", 30)

    turn_to(frame, "What if")
    press(frame, "Change this body…")
    expect(frame.get_by_text("128 episodes on Hw-Phy").first).to_be_attached()
    recorded, before = number_beside(frame, "link 1 [m]").input_value(), sizes_of(frame)

    entry = number_beside(frame, "link 1 [m]")
    entry.fill("4.4")
    entry.press("Enter")
    wait_for("another body", lambda: sizes_of(frame) != before, 30)
    expect(frame.get_by_text("a body changed by hand").first).to_be_attached()
    expect(frame.get_by_text("recorded body").first).to_be_attached()

    press(frame, "Which parameter limits it?")
    curves = frame.locator('svg[aria-label="success and return along the parameter"]')
    wait_for("a curve for each parameter", lambda: curves.count() == 5, 60)
    wait_for(
        "the end of the sweep", lambda: frame.get_by_role("button", name="Which parameter limits it?").count(), 120
    )

    press(frame, "Go on from here")
    wait_for("the answer", lambda: any(isinstance(a.command, InjectDesign) for a in events_of(run, Acknowledged)), 30)
    answer = next(a for a in events_of(run, Acknowledged) if isinstance(a.command, InjectDesign))
    assert answer.accepted
    assert isinstance(answer.command, InjectDesign)
    assert answer.command.phi[0] == 4.4

    press(frame, "Reset")
    wait_for("the recorded design", lambda: number_beside(frame, "link 1 [m]").input_value() == recorded, 10)
    press(frame, "Close")
    expect(frame.get_by_role("button", name="Change this body…")).to_be_attached()
