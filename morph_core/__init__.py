"""MORPH: co-optimise a robot's body and its controller through a neural proxy of its hardware."""
