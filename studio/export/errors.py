"""Why an export was refused."""


class ExportError(ValueError):
    """The design can't be exported as asked; the message says why and what is possible."""
