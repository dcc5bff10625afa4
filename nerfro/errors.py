"""The one exception that a user's mistake turns into."""


class NerfroError(Exception):
    """A mistake in the input, told in one line: what was wrong, what is allowed, what to do next.

    Entry points print the message alone and exit with status 1; anything else is a bug and keeps its traceback.
    """
