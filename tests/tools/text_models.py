"""Text towers of the real architectures with random weights, and what PyTorch says about 200 phrases.

    text_models.py OUT [clip] [egovideo]

For each: the folder that scripts/export_text_encoders.py writes, and beside it `expected.json` (phrases and tokens)
and `expected.npy` (embeddings). Tokens come from OpenCLIP's and BERT's own Python tokenizers, not from the exported
file. CLIP's vocabulary is the real one, which is part of open_clip; BERT's is not to be had without a download, so
a small one of the same format is made here: same algorithm, fewer words.
"""
import json
import os
import string
import sys

import numpy as np
import torch

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../scripts"))
import export_text_encoders as exporter  # noqa: E402

# Phrases that PyTorch embeds together.
BATCH = 25
VERBS = ["wash", "toast", "cut", "cook", "open", "pour", "sweep", "read", "fold", "switch on", "peel", "feed"]
THINGS = ["a kitchen utensil", "the bread", "vegetables", "food in the pan", "the fridge", "water into the glass",
          "the floor", "the newspaper", "a blanket", "the television", "an orange", "the dog"]
HARD = [
    "", " ", "   two   spaces  ", "\ttab\nnewline", "a", "42", "3.14 litres", "100% cotton", "e-mail@example.org",
    "café", "crème brûlée", "déjà vu", "jalapeño", "über-groß", "naïve façade", "smörgåsbord",
    "Ærøskøbing", "piñata", "Žižek", "İstanbul",
    "ﬁne ﬂour", "“curly quotes” and ‘single ones’", "it's the cook's knife", "don't you'll we've I'd",
    "🍳", "🍳 frying an egg 🥚", "👩‍🍳 chef", "🇩🇪 flag", "thumbs up 👍🏽", "❤️", "日本語の包丁", "마늘을 자르다", "резать овощи",
    "κόψε τα λαχανικά", "اقطع الخضار", "खाना पकाना", "ก๋วยเตี๋ยว", "cafe\u0301", "zero\u200bwidth", "soft\u00adhyphen",
    "non\u00a0breaking", "!!!???...", "#hashtag $5 @home", "C++ & C#", "snake_case kebab-case camelCase", "UPPER CASE PHRASE",
    "a_very_long_" + "word" * 40, "wash " * 120, "the quick brown fox jumps over the lazy dog " * 6,
    "pneumonoultramicroscopicsilicovolcanoconiosis", "½ cup of sugar", "x² + y²", "5°C", "€20", "№ 5", "™ and ©",
]


def phrases():
    listed = list(HARD)
    for verb in VERBS:
        for thing in THINGS:
            listed.append(f"{verb} {thing}")
    return listed[:200]


def bert_vocabulary(path):
    """Single characters, and words and endings of half of the phrases, in vocab.txt's format."""
    words = {w.lower() for p in phrases()[::2] for w in p.split() if w.isascii() and w.isalpha() and len(w) < 12}
    letters = {c for p in phrases() for c in p.lower() if not c.isspace()} | set(string.ascii_lowercase + string.digits)
    letters -= set("🥚日ก")  # some that are unknown
    pieces = {w[-n:] for w in words for n in (2, 3) if len(w) > n}
    special = ["[PAD]"] + [f"[unused{n}]" for n in range(5)] + ["[UNK]", "[CLS]", "[SEP]", "[MASK]"]
    listed = special + sorted(letters | words) + sorted("##" + p for p in pieces | {c for c in letters if c.isalnum()})
    open(path, "w", encoding="utf-8").write("\n".join(listed) + "\n")


def expect(module, out, inputs):
    """Writes phrases, their tokens (the first of the inputs, [phrases, context]) and PyTorch's embeddings."""
    found = []
    with torch.no_grad():
        for n in range(0, len(phrases()), BATCH):
            found.append(module(*(torch.tensor(i[n:n + BATCH]) for i in inputs)).numpy())
    np.save(f"{out}/expected.npy", np.concatenate(found).astype(np.float32))
    json.dump(dict(phrases=phrases(), tokens=inputs[0]), open(f"{out}/expected.json", "w"))


def clip(out):
    import open_clip
    torch.manual_seed(0)
    bpe = open_clip.SimpleTokenizer()
    module = exporter.load_clip("ViT-B-16", None)
    exporter.export(module, exporter.clip_tokenizer(bpe), out, "clip", "random ViT-B-16", bpe.context_length, 0)
    tokens = [bpe(p)[0].tolist() for p in phrases()]
    expect(module, out, [tokens])


def egovideo(out):
    from transformers.models.bert.tokenization_bert_legacy import BertTokenizerLegacy
    torch.manual_seed(0)
    os.makedirs(out, exist_ok=True)
    vocab = f"{out}/vocab.txt"
    bert_vocabulary(vocab)
    tokenizer, pad = exporter.bert_tokenizer(vocab)
    # As many words as bert-large-uncased has: the table is part of the model's size.
    module = exporter.load_egovideo(None, 19, 30522)
    exporter.export(module, tokenizer, out, "egovideo", "random EgoVideo", 20, pad)
    own = BertTokenizerLegacy(vocab, do_lower_case=True)
    tokens, masks = [], []
    for phrase in phrases():
        ids = own.convert_tokens_to_ids(own.tokenize(phrase))[:18]
        ids = [own.cls_token_id] + ids + [own.sep_token_id]
        masks.append([1] * len(ids) + [0] * (20 - len(ids)))
        tokens.append(ids + [own.pad_token_id] * (20 - len(ids)))
    expect(module, out, [tokens, masks])


if __name__ == "__main__":
    root, which = sys.argv[1], sys.argv[2:] or ["clip", "egovideo"]
    for name in which:
        dict(clip=clip, egovideo=egovideo)[name](os.path.join(root, name))
        print(f"{name}: {len(phrases())} phrases")
