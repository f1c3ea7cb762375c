"""`python -m torchslam` is the command `torchslam`, also where the scripts of an environment are not on the path."""

from torchslam.cli.main import console

if __name__ == "__main__":  # not where another process imports this module
    console()
