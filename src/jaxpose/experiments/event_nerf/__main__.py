"""`python -m jaxpose.experiments.event_nerf`."""

from jaxpose.experiments.event_nerf.pipeline import main

main()
