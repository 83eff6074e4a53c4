"""Linear rules whose bonds break: settling, breaking and settling again in one compiled call."""
