"""The population: many agents in lockstep, on the local devices, in a chunked host loop."""
