"""Trained policies for others: cards beside ONNX files, and the way to the Hugging Face hub and back."""
