"""Tables, figures, maps and files that people read, made from results alone."""
