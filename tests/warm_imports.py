"""What the verbs import, once; see started.py."""

import importlib
import pkgutil

import jointctl.tools.verbs as verbs

for found in pkgutil.iter_modules(verbs.__path__):
    if not found.name.startswith("__"):
        importlib.import_module(f"{verbs.__name__}.{found.name}")
