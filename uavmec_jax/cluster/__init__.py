"""Work on many processes and machines with Ray: a cluster that is started or joined, and tasks that survive it."""
