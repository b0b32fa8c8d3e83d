"""Changes within a recording, each as an observable: terms of the balance, duty, noise, hum, levels of pressure."""
