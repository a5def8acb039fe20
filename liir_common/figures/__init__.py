"""The paper's figures, drawn from run directories and results files."""
