"""Readers with limits, atomic writes, checked archives and locks; of our package they import the errors alone."""
