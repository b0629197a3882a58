"""`python -m keyss`."""

from keyss.cli.process import main

if __name__ == "__main__":
    main()
