//! Phrases: what the options say is asked of the features.

use divff::config::Config;
use divff::pipeline::RunFolder;
use divff::scene::Scene;
use divff::scene::features::Space;
use divff::semantics::layers::FeatureLayers;
use divff::semantics::{SemanticFields, SemanticsError, TextSource};

use super::args::{LayerArg, RenderArgs, SpaceArg, TextArgs};
use super::error::CliError;

impl From<SpaceArg> for Space {
    fn from(space: SpaceArg) -> Self {
        match space {
            SpaceArg::Clip => Self::Clip,
            SpaceArg::Egovideo => Self::Egovideo,
        }
    }
}

/// Embeddings of the phrases asked for.
pub fn text_source(args: &TextArgs, scene: &Scene) -> Result<TextSource, CliError> {
    let mut text = TextSource::of_scene(scene)?;
    if let Some(path) = &args.text_embedding {
        text.give(args.space.into(), &args.text, path)?;
    }
    Ok(text)
}

/// The layers of features that `divff render` is asked for.
pub fn feature_layers<'a>(
    args: &RenderArgs,
    scene: &Scene,
    run: &RunFolder,
    fields: Option<&'a SemanticFields>,
    config: &Config,
) -> Result<FeatureLayers<'a>, CliError> {
    let wants = |layer| args.layers.contains(&layer);
    let scores = wants(LayerArg::Relevancy);
    match (scores, args.text.text.is_empty()) {
        (true, true) => {
            return Err(CliError::Usage {
                option: "--layers relevancy".into(),
                what: "no phrase is given".into(),
                remedy: "say what to look for with --text",
            });
        }
        (false, false) => {
            return Err(CliError::Usage {
                option: "--text".into(),
                what: "no layer shows it".into(),
                remedy: "add relevancy to --layers",
            });
        }
        _ => {}
    }
    let mut layers = FeatureLayers::new(&config.semantics);
    let text = if scores { text_source(&args.text, scene)? } else { TextSource::default() };
    let temperature = args.text.temperature.unwrap_or(config.semantics.temperature);
    for (space, layer) in [(Space::Clip, LayerArg::Clip), (Space::Egovideo, LayerArg::Egovideo)] {
        let scores = scores && Space::from(args.text.space) == space;
        if !scores && !wants(layer) {
            continue;
        }
        let fields = fields.ok_or_else(|| SemanticsError::NoFeatures {
            space,
            why: format!("{} holds none, or of another geometry", run.root().display()),
        })?;
        let phrases: &[String] = if scores { &args.text.text } else { &[] };
        layers.add(fields, space, wants(layer), phrases, &text, temperature)?;
    }
    Ok(layers)
}
