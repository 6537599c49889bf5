"""HTML that can be pressed: viser hears of no click on it, but a label in it presses the button that it belongs to."""

from collections.abc import Callable, Sequence

import viser

from studio.viewer import wording


class Links:
    """Buttons in a folded list, which HTML elsewhere on the page presses; the keyboard reaches the list itself."""

    def __init__(self, gui: viser.GuiApi, on_press: Callable[[int], None]) -> None:
        """Make the list where the caller stands; `on_press` is called with the place of a link among those offered."""
        self._gui = gui
        self._on_press = on_press
        self._buttons: list[viser.GuiButtonHandle] = []
        self.list = gui.add_folder("As a list", expand_by_default=False, visible=False)

    def offer(self, names: Sequence[str]) -> None:
        """Offer links of these names, and none of those before."""
        with self.list:
            while len(self._buttons) < len(names):
                button, place = self._gui.add_button("", visible=False), len(self._buttons)
                button.on_click(lambda _, place=place: self._on_press(place))
                self._buttons.append(button)
        for name, button in zip(names, self._buttons, strict=False):
            button.label = name
        for i, button in enumerate(self._buttons):
            button.visible = i < len(names)
        self.list.visible = bool(names)

    def link(self, place: int, content: str, title: str, style: str = "") -> str:
        """Return HTML that presses a link when it is clicked; `content` is HTML already."""
        return (
            f'<label for="{self._buttons[place]._impl.uuid}" title="{wording.text(title)}" '
            f'style="cursor:pointer;{style}">{content}</label>'
        )
