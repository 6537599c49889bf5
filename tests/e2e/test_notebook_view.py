"""What `design.view()` puts into a notebook: a frame in which the hand runs, and which reaches nothing around it."""

from pathlib import Path

import pytest
from playwright.sync_api import Page

from studio.notebook import open_run
from tests.hands import write_trained_run

pytestmark = pytest.mark.browser


def test_a_hand_runs_in_the_frame_and_the_notebook_is_out_of_its_reach(page: Page, tmp_path: Path) -> None:
    view = open_run(write_trained_run(tmp_path, "pen_press").path).design().view()
    page.context.set_offline(True)
    page.set_content(f"<title>A notebook</title>{view._repr_html_()}")
    (frame,) = page.main_frame.child_frames
    frame.evaluate("""show.ready.then((state) => new Promise((go) => {
        (function look() { state.simulated > 0.2 ? go() : setTimeout(look, 50); })();
    }))""")  # the page lets no text be made a program in between, as waiting for a function does
    assert frame.evaluate("(() => { try { return parent.document.title } catch { return 'out of reach' } })()") == (
        "out of reach"
    )
