"""What those who pass on people's wishes need of the page on which they were uttered."""

from typing import Protocol

import numpy as np
import viser

from morph_core.history import History


class Screen(Protocol):
    """A page that shows a run, and says what was not done."""

    def select(self, run_id: str | None) -> None:
        """Open the run of that name, or the start panel if it is None."""
        ...

    def refresh(self) -> None:
        """Bring the page up to date."""
        ...

    def shown_design(self, history: History) -> tuple[int, np.ndarray]:
        """Return the iteration and phi (d,) of a run that are seen."""
        ...

    def refuse(self, sentence: str, client: viser.ClientHandle | None) -> None:
        """Say why something was not done, to the one who asked and above the panels."""
        ...

    def tell(self, sentence: str | None) -> None:
        """Show a sentence above the panels; None takes the last one away."""
        ...
