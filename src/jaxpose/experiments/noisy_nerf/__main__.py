"""`python -m jaxpose.experiments.noisy_nerf`."""

from jaxpose.experiments.noisy_nerf.pipeline import main

main()
