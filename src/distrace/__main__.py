"""`python -m distrace`: the command line."""

from distrace.cli import main

if __name__ == "__main__":  # helpers that it starts import this again, by another name
    main()
