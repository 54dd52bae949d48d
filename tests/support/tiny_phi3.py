"""Build a tiny random Phi-3 for onnxruntime-genai: `python tests/support/tiny_phi3.py FOLDER` writes FOLDER/onnx."""

import subprocess
import sys
from pathlib import Path

_SPECIAL = ["<unk>", "<s>", "</s>", "<|endoftext|>", "<|system|>", "<|user|>", "<|assistant|>", "<|end|>"]


def build(folder: Path) -> None:
    """Write a model with a byte-level tokenizer and two layers of 64, exported by the library's builder."""
    import torch
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import Phi3Config, Phi3ForCausalLM, PreTrainedTokenizerFast

    source = folder / "source"
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(vocab_size=400, special_tokens=_SPECIAL, initial_alphabet=alphabet)
    tokenizer.train_from_iterator(["Pick up the mug on the table and find the nearest chair"] * 5, trainer)
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, unk_token="<unk>", bos_token="<s>", eos_token="<|endoftext|>",
        pad_token="<|endoftext|>",
    )  # fmt: skip
    fast.save_pretrained(source)
    torch.manual_seed(0)
    config = Phi3Config(
        vocab_size=len(fast), hidden_size=64, intermediate_size=128, num_hidden_layers=2, num_attention_heads=4,
        num_key_value_heads=4, max_position_embeddings=4096, original_max_position_embeddings=4096,
        initializer_range=0.5,
        bos_token_id=1, eos_token_id=3, pad_token_id=3,
    )  # fmt: skip
    Phi3ForCausalLM(config).save_pretrained(source)
    arguments = ["-i", source, "-o", folder / "onnx", "-p", "fp32", "-e", "cpu", "-c", folder / "cache"]
    subprocess.run([sys.executable, "-m", "onnxruntime_genai.models.builder", *map(str, arguments)], check=True)


if __name__ == "__main__":
    build(Path(sys.argv[1]))
