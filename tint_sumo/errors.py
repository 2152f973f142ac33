"""The one exception type for mistakes a user can mend."""


class InputError(ValueError):
    """Bad input: one line that says what is wrong and how to mend it. The command line exits with code 2 on it."""


RENAMED_METHODS = {"ours": "vae", "ours_plus": "cross_window"}  # what methods were called up to version 0.1


def refuse_old_name(name: object) -> None:
    """Raise InputError where a method or model is called by a name of the past."""
    if str(name) in RENAMED_METHODS:
        raise InputError(f"{name!s} is now called {RENAMED_METHODS[str(name)]}; use that name")
