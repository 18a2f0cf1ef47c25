"""What a user hands in: scenarios, states, places and policies, with the schemas of their files."""
