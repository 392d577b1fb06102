"""Writes a tiny vision model with random weights as GGUF files: what it says is noise, but it is served by a real server.

usage: tiny_model.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np
from gguf import GGUFWriter, TokenType

WIDTH = 64
LAYERS = 2
HEADS = 4
FEED_FORWARD = 128
CONTEXT = 16384
PICTURE = 56
PATCH = 14

random = np.random.default_rng(7)


def tensor(*shape: int) -> np.ndarray:
    return (random.standard_normal(shape) * 0.05).astype(np.float32)


def vocabulary() -> tuple[list[bytes], list[float], list[int]]:
    """Returns a token for each byte, and some for words."""
    tokens = [b"<unk>", b"<s>", b"</s>"]
    kinds = [TokenType.UNKNOWN, TokenType.CONTROL, TokenType.CONTROL]
    tokens += [f"<0x{byte:02X}>".encode() for byte in range(256)]
    kinds += [TokenType.BYTE] * 256
    for letter in "▁abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.,:;!?\"'{}[]()-_/<>=*#":
        tokens.append(letter.encode())
        kinds.append(TokenType.NORMAL)
    scores = [-float(index) for index in range(len(tokens))]
    return tokens, scores, [int(kind) for kind in kinds]


def text_model(file: Path) -> None:
    writer = GGUFWriter(file, "llama")
    tokens, scores, kinds = vocabulary()
    writer.add_name("tiny")
    writer.add_context_length(CONTEXT)
    writer.add_embedding_length(WIDTH)
    writer.add_block_count(LAYERS)
    writer.add_feed_forward_length(FEED_FORWARD)
    writer.add_head_count(HEADS)
    writer.add_head_count_kv(HEADS)
    writer.add_rope_dimension_count(WIDTH // HEADS)
    writer.add_layer_norm_rms_eps(1e-5)
    writer.add_vocab_size(len(tokens))
    writer.add_tokenizer_model("llama")
    writer.add_token_list(tokens)
    writer.add_token_scores(scores)
    writer.add_token_types(kinds)
    writer.add_bos_token_id(1)
    writer.add_eos_token_id(2)
    writer.add_unk_token_id(0)
    writer.add_chat_template(
        "{% for message in messages %}{{ message['role'] + ': ' + message['content'] + '\\n' }}{% endfor %}assistant: "
    )
    # The first number of each state is large, and tells single bytes from letters: noise, but valid UTF-8.
    embeddings, output = tensor(len(tokens), WIDTH), tensor(len(tokens), WIDTH)
    embeddings[:, 0] = 2.0
    output[:, 0] = [1.0 if kind in (TokenType.NORMAL, TokenType.CONTROL) else -3.0 for kind in kinds]
    writer.add_tensor("token_embd.weight", embeddings)
    writer.add_tensor("output_norm.weight", np.ones(WIDTH, dtype=np.float32))
    writer.add_tensor("output.weight", output)
    for layer in range(LAYERS):
        block = f"blk.{layer}"
        writer.add_tensor(f"{block}.attn_norm.weight", np.ones(WIDTH, dtype=np.float32))
        writer.add_tensor(f"{block}.ffn_norm.weight", np.ones(WIDTH, dtype=np.float32))
        for name in ("attn_q", "attn_k", "attn_v", "attn_output"):
            writer.add_tensor(f"{block}.{name}.weight", tensor(WIDTH, WIDTH))
        writer.add_tensor(f"{block}.ffn_gate.weight", tensor(FEED_FORWARD, WIDTH))
        writer.add_tensor(f"{block}.ffn_up.weight", tensor(FEED_FORWARD, WIDTH))
        writer.add_tensor(f"{block}.ffn_down.weight", tensor(WIDTH, FEED_FORWARD))
    finish(writer)


def picture_model(file: Path) -> None:
    """The layout of LLaVA: a vision transformer, and two layers that project its patches to tokens."""
    writer = GGUFWriter(file, "clip")
    writer.add_bool("clip.has_vision_encoder", True)
    writer.add_bool("clip.has_text_encoder", False)
    writer.add_bool("clip.has_llava_projector", True)
    writer.add_string("clip.projector_type", "mlp")
    writer.add_bool("clip.use_gelu", False)
    writer.add_uint32("clip.vision.image_size", PICTURE)
    writer.add_uint32("clip.vision.patch_size", PATCH)
    writer.add_uint32("clip.vision.embedding_length", WIDTH)
    writer.add_uint32("clip.vision.feed_forward_length", FEED_FORWARD)
    writer.add_uint32("clip.vision.projection_dim", WIDTH)
    writer.add_uint32("clip.vision.attention.head_count", HEADS)
    writer.add_float32("clip.vision.attention.layer_norm_epsilon", 1e-5)
    writer.add_uint32("clip.vision.block_count", LAYERS)
    writer.add_array("clip.vision.image_mean", [0.5, 0.5, 0.5])
    writer.add_array("clip.vision.image_std", [0.5, 0.5, 0.5])
    patches = (PICTURE // PATCH) ** 2
    writer.add_tensor("v.class_embd", tensor(WIDTH))
    writer.add_tensor("v.patch_embd.weight", tensor(WIDTH, 3, PATCH, PATCH))
    writer.add_tensor("v.position_embd.weight", tensor(patches + 1, WIDTH))
    for name in ("v.pre_ln", "v.post_ln"):
        norm(writer, name)
    for layer in range(LAYERS):
        block = f"v.blk.{layer}"
        for name in ("ln1", "ln2"):
            norm(writer, f"{block}.{name}")
        for name in ("attn_q", "attn_k", "attn_v", "attn_out"):
            linear(writer, f"{block}.{name}", WIDTH, WIDTH)
        linear(writer, f"{block}.ffn_up", FEED_FORWARD, WIDTH)
        linear(writer, f"{block}.ffn_down", WIDTH, FEED_FORWARD)
    linear(writer, "mm.0", WIDTH, WIDTH)
    linear(writer, "mm.2", WIDTH, WIDTH)
    finish(writer)


def norm(writer: GGUFWriter, name: str) -> None:
    writer.add_tensor(f"{name}.weight", np.ones(WIDTH, dtype=np.float32))
    writer.add_tensor(f"{name}.bias", np.zeros(WIDTH, dtype=np.float32))


def linear(writer: GGUFWriter, name: str, rows: int, columns: int) -> None:
    writer.add_tensor(f"{name}.weight", tensor(rows, columns))
    writer.add_tensor(f"{name}.bias", np.zeros(rows, dtype=np.float32))


def finish(writer: GGUFWriter) -> None:
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    text_model(folder / "tiny.gguf")
    picture_model(folder / "tiny-pictures.gguf")
