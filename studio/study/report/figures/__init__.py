"""The figures of a report: one file = one group of them; each function returns Drawings, none where there is no data."""
