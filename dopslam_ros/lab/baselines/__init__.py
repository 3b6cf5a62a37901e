"""Other estimators to compare with."""
