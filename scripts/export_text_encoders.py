#!/usr/bin/env python3
"""Export the text towers of CLIP and EgoVideo, so that `divff` can embed phrases by itself, without Python.

    python export_text_encoders.py clip     --checkpoint open_clip_pytorch_model.bin --out encoders/clip
    python export_text_encoders.py egovideo --checkpoint egovideo.pt --vocab vocab.txt --out encoders/egovideo

writes `model.onnx`, `tokenizer.json` and `encoder.json` to the folder that `--out` names. Do it once per model;
nothing is downloaded. Needs torch, onnx, onnxscript and tokenizers; `clip` also open_clip_torch, `egovideo` also
transformers.

clip      the text tower of OpenCLIP (default ViT-B-16; the paper's weights are laion2b_s34b_b88k).
egovideo  BERT (bert-large-uncased, its first 19 layers) and a projection to 512 numbers; `--vocab` is the
          vocabulary of bert-large-uncased. Texts have 20 tokens.
"""
import argparse
import json
import os
import sys

import torch

CLIP_PATTERN = r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
# What ftfy.fix_text, which OpenCLIP runs first, makes of quotes and ligatures.
UNCURLED = {**dict.fromkeys("\u2018\u2019\u201a\u201b\u02bc", "'"), **dict.fromkeys("\u201c\u201d\u201e\u201f", '"'),
            "\ufb00": "ff", "\ufb01": "fi", "\ufb02": "fl", "\ufb03": "ffi", "\ufb04": "ffl"}


class ClipText(torch.nn.Module):
    """Tokens [1, up to 77] of an OpenCLIP model to an embedding [1, D] of unit length.

    Where every token sees only the ones before it and the embedding is the end's, padding behind the end changes
    nothing: then any number of tokens is taken, else always the model's full context.
    """

    inputs = ["input_ids"]

    def __init__(self, model):
        super().__init__()
        self.model = model
        self.any_length = (getattr(model, "attn_mask", None) is not None
                           and getattr(model, "text_pool_type", None) in ("argmax", "eos"))

    def forward(self, input_ids):
        if not self.any_length:
            return self.model.encode_text(input_ids, normalize=True)
        from open_clip.transformer import text_global_pool
        model, tokens = self.model, input_ids.shape[1]
        x = model.token_embedding(input_ids) + model.positional_embedding[:tokens]
        x = model.ln_final(model.transformer(x, attn_mask=model.attn_mask[:tokens, :tokens]))
        x = text_global_pool(x, input_ids, model.text_pool_type, eos_token_id=getattr(model, "text_eos_id", None))
        if isinstance(model.text_projection, torch.nn.Linear):
            x = model.text_projection(x)
        elif model.text_projection is not None:
            x = x @ model.text_projection
        return torch.nn.functional.normalize(x, dim=-1)


class EgoVideoText(torch.nn.Module):
    """Tokens and mask [1, up to 20] to an embedding [1, D] of unit length: BERT's first state, projected."""

    inputs = ["input_ids", "attention_mask"]
    any_length = True

    def __init__(self, bert, projection):
        super().__init__()
        self.bert = bert
        self.projection = torch.nn.Parameter(projection)

    def forward(self, input_ids, attention_mask):
        state = self.bert(input_ids=input_ids, attention_mask=attention_mask).last_hidden_state[:, 0]
        return torch.nn.functional.normalize(state @ self.projection, dim=-1)


def load_clip(name, checkpoint):
    """The OpenCLIP model `name` with the weights of a file, or random ones for `None`."""
    import open_clip
    model = open_clip.create_model(name, pretrained=None)
    if checkpoint is not None:
        open_clip.load_checkpoint(model, checkpoint)
    return ClipText(model).eval()


def clip_tokenizer(bpe):
    """OpenCLIP's tokenizer `bpe` (its SimpleTokenizer) in the format of the `tokenizers` library."""
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors
    merges = [pair for pair, _ in sorted(bpe.bpe_ranks.items(), key=lambda item: item[1])]
    start, end = bpe.sot_token_id, bpe.eot_token_id
    start_text, end_text = bpe.decoder[start], bpe.decoder[end]
    model = models.BPE(vocab=bpe.encoder, merges=merges, end_of_word_suffix="</w>", unk_token=end_text)
    tokenizer = Tokenizer(model)
    steps = [normalizers.NFC()] + [normalizers.Replace(a, b) for a, b in UNCURLED.items()]
    tokenizer.normalizer = normalizers.Sequence(
        steps + [normalizers.Replace(Regex(r"\s+"), " "), normalizers.Strip(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([
        pre_tokenizers.Split(Regex(CLIP_PATTERN), behavior="removed", invert=True),
        pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)])
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{start_text} $A {end_text}", special_tokens=[(start_text, start), (end_text, end)])
    return tokenizer


def load_egovideo(checkpoint, layers, vocabulary):
    """BERT-large with `layers` layers, and its projection; random weights for `None`."""
    from transformers import BertConfig, BertModel
    config = BertConfig(vocab_size=vocabulary, hidden_size=1024, intermediate_size=4096, num_hidden_layers=layers,
                        num_attention_heads=16, attn_implementation="eager")
    bert = BertModel(config, add_pooling_layer=False)
    projection = torch.randn(1024, 512) * 1024**-0.5
    if checkpoint is not None:
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)
        for key in ("module", "model", "state_dict"):
            state = state.get(key, state)
        state = {k.removeprefix("module."): v.float() for k, v in state.items()}
        tower = {k.removeprefix("textual."): v for k, v in state.items() if k.startswith("textual.")}
        if "text_projection" not in state or not tower:
            sys.exit(f"{checkpoint}: no `textual.*` and `text_projection`; is it EgoVideo's checkpoint?")
        projection = state["text_projection"]
        found = bert.load_state_dict(tower, strict=False)
        # Position numbers are not weights; layers beyond the ones that are used may be there.
        missing = [k for k in found.missing_keys if not k.endswith("position_ids")]
        if missing:
            sys.exit(f"{checkpoint}: it lacks {len(missing)} weights such as {missing[:3]}; check --layers")
    return EgoVideoText(bert, projection).eval()


def bert_tokenizer(vocab):
    """The uncased WordPiece tokenizer of a `vocab.txt`."""
    from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors
    words = [line.rstrip("\n") for line in open(vocab, encoding="utf-8")]
    ids = {word: n for n, word in enumerate(words)}
    for needed in ("[PAD]", "[UNK]", "[CLS]", "[SEP]"):
        if needed not in ids:
            sys.exit(f"{vocab}: no {needed} in it; it should be the vocabulary of bert-large-uncased")
    tokenizer = Tokenizer(models.WordPiece(vocab=ids, unk_token="[UNK]", max_input_chars_per_word=100))
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    tokenizer.post_processor = processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", ids["[CLS]"]), ("[SEP]", ids["[SEP]"])])
    return tokenizer, ids["[PAD]"]


def export(module, tokenizer, out, space, name, context, pad):
    """Writes the three files; `encoder.json` last, so that a folder that has it is complete."""
    os.makedirs(out, exist_ok=True)
    ids = torch.zeros(1, context, dtype=torch.int64)
    ids[0, :2] = torch.tensor([1, 2])
    example = (ids,) if len(module.inputs) == 1 else (ids, torch.ones_like(ids))
    with torch.no_grad():
        dim = module(*example).shape[-1]
        path = f"{out}/model.onnx"
        tokens = torch.export.Dim("tokens", min=2, max=context)
        shapes = tuple({1: tokens} for _ in example) if module.any_length else None
        torch.onnx.export(module, example, path, input_names=module.inputs, output_names=["text_embedding"],
                          dynamic_shapes=shapes, opset_version=18, dynamo=True, external_data=False, verbose=False)
    tokenizer.save(f"{out}/tokenizer.json")
    about = dict(space=space, model=name, context=context, pad=pad, dim=dim)
    with open(f"{out}/encoder.json.tmp", "w") as file:
        json.dump(about, file, indent=1)
    os.replace(f"{out}/encoder.json.tmp", f"{out}/encoder.json")
    return about


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_subparsers(dest="which", required=True)
    clip = which.add_parser("clip")
    clip.add_argument("--model", default="ViT-B-16", help="name of the architecture in open_clip")
    ego = which.add_parser("egovideo")
    ego.add_argument("--vocab", required=True, help="vocab.txt of bert-large-uncased")
    ego.add_argument("--layers", type=int, default=19, help="BERT layers that the text tower uses")
    for sub in (clip, ego):
        sub.add_argument("--checkpoint", required=True, help="file of weights")
        sub.add_argument("--out", required=True, help="folder to write to")
    args = parser.parse_args()
    for path in (args.checkpoint, getattr(args, "vocab", None)):
        if path and not os.path.isfile(path):
            parser.error(f"{path} does not exist")
    if args.which == "clip":
        import open_clip
        module = load_clip(args.model, args.checkpoint)
        bpe = open_clip.SimpleTokenizer()
        tokenizer = clip_tokenizer(bpe)
        about = export(module, tokenizer, args.out, "clip", args.model, bpe.context_length, 0)
    else:
        tokenizer, pad = bert_tokenizer(args.vocab)
        module = load_egovideo(args.checkpoint, args.layers, tokenizer.get_vocab_size())
        about = export(module, tokenizer, args.out, "egovideo", "EgoVideo", 20, pad)
    print(f"{args.out}: {about}")


if __name__ == "__main__":
    main()
