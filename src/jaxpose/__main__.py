"""`python -m jaxpose` is `jaxpose`."""

from jaxpose.cli.main import main

if __name__ == "__main__":
    main()
