"""The experiment of section V of the paper, and the biped it moves: not part of the library."""
