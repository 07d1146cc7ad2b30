"""Training runs, controllers and evaluations, run from a checkout (``python -m agents.NAME``); not part of the wheel.

As a script, a module that is not installed and Ctrl-C end it in one line instead of a traceback.
"""

from __future__ import annotations

import sys
from types import TracebackType

#: Extras with all that the scripts of a folder need, where it is not ``train``.
_EXTRAS = {"datasets": "datasets", "fit": "fit", "rllib": "train,multi", "rsl_rl": "rsl", "skrl": "skrl"}


def _in_one_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Report what ended a script."""
    module = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if isinstance(error, KeyboardInterrupt):
        print("\ninterrupted before the end; begin again with the same command", file=sys.stderr)
    elif module and module not in ("agents", "piavatar_envs"):
        print(f"error: {_remedy(module)}", file=sys.stderr)
    elif type(error).__name__ in ("MissingExtra", "KernelCacheError"):
        print(f"error: {error}", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


def _remedy(module: str) -> str:
    """Return what a script needs, and the command that installs it."""
    try:
        from piavatar_envs.core.extras import extra_of, missing
    except ImportError:  # a module that the package itself needs
        return f'this script needs {module}, which is not installed; in the checkout: pip install -e ".[train]"'
    library = next((word.split(".")[1] for word in sys.orig_argv if word.startswith("agents.")), "")
    return str(missing("this script", module, _EXTRAS.get(library) or extra_of(module)))


# while Python looks for the module that it runs, which may be of a package that imports this one
if sys.argv[:1] == ["-m"] and any(word.removeprefix("-m").startswith("agents.") for word in sys.orig_argv):
    sys.excepthook = _in_one_line
