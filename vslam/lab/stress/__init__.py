"""At which strength does a run fail: bisection over laws, systems and seeds, and its report."""
