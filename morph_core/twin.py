"""A second proxy beside the first, which learns Hw-Phy alone: the two differ by what the task asks of the hardware."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from morph_core.search import Dataset, Memory

if TYPE_CHECKING:
    from morph_core.hw_nn import HwNN


@dataclass
class Twin(Memory):
    """A second proxy, trained on Hw-Phy without the task's gradient.

    drift(s, a) = proxy(s, a) - reference(s, a) is how the task would like z to change.
    """

    reference: "HwNN"

    @property
    def learners(self) -> Mapping[str, "HwNN"]:
        return {"reference": self.reference}

    def drift(self, dataset: Dataset) -> np.ndarray:
        """Return the drift (n, z_size) of a dataset that the proxy has labelled."""
        return dataset.z - self.reference(dataset.s, dataset.a)

    def proxy_was_fitted(self, hw_nn: "HwNN") -> None:
        """Let the reference start as the proxy is."""
        self.reference.copy_weights(hw_nn)

    def learn(self, features: Any, target: Any) -> None:
        self.reference.learn(features, target)

    def phi_was_found(self, hw_nn: "HwNN") -> None:
        """Copy the reference's weights and Adam moments into the proxy: phi has just followed their difference, so it
        starts at zero again."""
        hw_nn.copy_weights(self.reference)
        hw_nn.copy_moments(self.reference)
