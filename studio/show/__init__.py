"""One offline HTML file in which an exported hand runs live."""
