"""`python -m jaxpose` is `jaxpose`."""

from jaxpose.cli import main

if __name__ == "__main__":
    main()
