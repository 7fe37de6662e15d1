"""`python -m jaxpose.experiments.planar`."""

from jaxpose.experiments.command import start

if __name__ == "__main__":
    start("jaxpose.experiments.planar.pipeline")
