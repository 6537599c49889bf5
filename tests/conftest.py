"""Settings for all tests."""

import hypothesis

hypothesis.settings.register_profile("studio", deadline=None)  # the first example pays for imports and caches
hypothesis.settings.load_profile("studio")
