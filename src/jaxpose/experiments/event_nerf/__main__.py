"""`python -m jaxpose.experiments.event_nerf`."""

from jaxpose.experiments.command import start

if __name__ == "__main__":
    start("jaxpose.experiments.event_nerf.pipeline")
