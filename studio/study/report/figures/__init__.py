"""The figures of a report: one file = one group of them; each function yields Drawings, none where there is no data."""
