"""The one exception for everything a user can cause and put right."""

import difflib


class UserError(Exception):
    """A mistake in the input. Its text is one line: where (file, key, view), what is wrong, what to do.

    The command prints it without a traceback and exits with status 2. What it quotes (a key, a file name, another
    library's message) may hold line breaks; they become spaces.
    """

    def __init__(self, text):
        super().__init__(" ".join(str(text).split()))


def did_you_mean(name, known):
    """'; did you mean 'position'?' for the known name nearest to `name`, or '' where none is near."""
    near = difflib.get_close_matches(str(name), [str(k) for k in known], n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else ""


def refuse_unknown(option, value, what, known):
    """UserError where the value of an option is none of those known. what: 'stage'. None is no value, and passes."""
    if value is not None and value not in known:
        hint = f"there is {', '.join(known)}{did_you_mean(value, known)}"
        raise UserError(f"{option} {value}: there is no such {what}; {hint}")


def name_some(names, most=5):
    """'a, b, c and 4 more': a list short enough for one line."""
    names = [str(name) for name in names]
    rest = len(names) - most
    return ", ".join(names) if rest <= 0 else f"{', '.join(names[:most])} and {rest} more"


def amount(count, noun, plural=None):
    """'1 line', '2 lines', '3 more boxes'."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"
