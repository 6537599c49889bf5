"""Why there is no film or still: an error whose message says what still works."""


class FilmError(ValueError):
    """Error of a film or a still that can't be made; the message says why, and what still can be done."""


class DiskFullError(FilmError):
    """Error of a film for which the disk has no room; the message says how the command line goes on."""
