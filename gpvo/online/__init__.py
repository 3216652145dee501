"""What flies: features, the model file and the predictor. NumPy and safetensors only."""
