"""The program that trains prior models: `python -m train fit --config train/gru.yaml`."""
