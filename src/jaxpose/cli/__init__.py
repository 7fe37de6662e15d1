"""The subcommands of `jaxpose`, one a module: `Config`, `run(config)` for notebooks too, `report(result)`.

A module here loads JAX and matplotlib in its functions only, so that `--help`, and what needs neither, is
quick.
"""
