"""Cases: the single records of a campaign, from their inputs and seeds to the row with their results."""
