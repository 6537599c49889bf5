"""The report of a study, made from its run folders at any time: tables, figures, the paper's claims, one page."""
