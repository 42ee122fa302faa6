# MuJoCo's bindings are a compiled module without stubs: everything in it counts as Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
