"""The one exception type for mistakes a user can mend."""


class InputError(ValueError):
    """Bad input: one line that says what is wrong and how to mend it. The command line exits with code 2 on it."""
