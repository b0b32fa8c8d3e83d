"""What a recording's observables mean: events that explain them, healthy recordings as their null, one verdict."""
