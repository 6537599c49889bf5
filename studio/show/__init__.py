"""HTML files that need no network: a hand that runs live, and the evolution of runs."""
