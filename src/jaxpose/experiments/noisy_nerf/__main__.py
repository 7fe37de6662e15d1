"""`python -m jaxpose.experiments.noisy_nerf`."""

from jaxpose.experiments.command import start

if __name__ == "__main__":
    start("jaxpose.experiments.noisy_nerf.pipeline")
