"""Studies: filters beside each other on the same simulated runs, with what chance leaves open."""
