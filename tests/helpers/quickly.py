"""Compilation for tests, in which nobody waits for numerical speed."""

import jax
from jax._src import compiler  # there is no public way to give an option to all that is compiled

# Of jax 0.10: fusions without MLIR compile in a third of the time. Later versions have no such option.
_OPTION = {"xla_cpu_use_fusion_emitters": False}
_get_compile_options = compiler.get_compile_options
_quickly = False


def _with_option(*args, **options):
    if _quickly:
        options["env_options_overrides"] = _OPTION | (options.get("env_options_overrides") or {})
    return _get_compile_options(*args, **options)


def compile_quickly(quickly: bool) -> None:
    """From here on, compile quickly or as users have it; what is compiled already stays as it is."""
    global _quickly
    jax.config.update("jax_disable_most_optimizations", quickly)
    _quickly = quickly


def _accepted() -> bool:
    try:
        jax.jit(lambda x: x + 1, compiler_options=_OPTION)(0)
    except jax.errors.JaxRuntimeError:
        return False
    return True


if _accepted():
    compiler.get_compile_options = _with_option
