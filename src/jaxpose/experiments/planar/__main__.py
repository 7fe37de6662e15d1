"""`python -m jaxpose.experiments.planar`."""

from jaxpose.experiments.planar.pipeline import main

main()
