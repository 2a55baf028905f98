"""Text queries: relevancy of features to prompts. Importable without nerfstudio."""
