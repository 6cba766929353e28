"""What every part of the package uses: checks of arguments, memory, optional libraries, short texts."""
