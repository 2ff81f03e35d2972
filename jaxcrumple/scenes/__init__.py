"""Ready-made scenes: the experiments of the paper, further tests of crumpling, and two snap-throughs."""
