"""The posterior Cramér-Rao bound of vehicle and map."""
