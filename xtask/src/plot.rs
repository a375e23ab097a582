//! Plots as SVG.

use anyhow::anyhow;
pub(crate) use plotters::chart::SeriesLabelPosition;
use plotters::prelude::*;

/// Dark enough for a thin line on white.
const COLORS: [RGBColor; 10] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 39, 40),
    RGBColor(44, 160, 44),
    RGBColor(148, 103, 189),
    RGBColor(230, 120, 10),
    RGBColor(23, 160, 175),
    RGBColor(140, 86, 75),
    RGBColor(200, 80, 160),
    RGBColor(100, 100, 100),
    RGBColor(150, 150, 20),
];

/// What a series looks like.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Look {
    /// Points joined by a line.
    Curve,
    /// A bold line without points.
    Front,
    /// Large hollow points.
    Marks,
    /// A horizontal dashed line from edge to edge, at the first point.
    Level,
}

/// Named points.
pub(crate) struct Series {
    pub(crate) name: String,
    pub(crate) points: Vec<(f64, f64)>,
    pub(crate) look: Look,
}

/// A plot; an axis with `log` shows powers of ten.
pub(crate) struct Plot {
    pub(crate) caption: String,
    pub(crate) x: Axis,
    pub(crate) y: Axis,
    pub(crate) series: Vec<Series>,
    /// How many series in a row share a color, each paler than the one before.
    pub(crate) shades: usize,
    /// The corner that the curves leave free.
    pub(crate) legend: SeriesLabelPosition,
}

#[derive(Clone, Copy)]
pub(crate) struct Axis {
    pub(crate) label: &'static str,
    pub(crate) log: bool,
}

impl Axis {
    fn to(self, v: f64) -> f64 {
        if self.log { v.log10() } else { v }
    }

    fn text(self, v: f64) -> String {
        let v = if self.log { 10f64.powf(v) } else { v };
        match v.abs() {
            a if a == 0.0 || (0.01..1e5).contains(&a) => format!("{}", (v * 1000.0).round() / 1000.0),
            _ => format!("{v:.1e}"),
        }
    }

    /// The range of the values, with a margin.
    fn range(self, values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
        let (low, high) = values.filter(|v| v.is_finite()).fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        let margin = (0.05 * (high - low)).max(1e-3);
        low - margin..high + margin
    }
}

impl Plot {
    /// The plot as the text of an SVG file.
    pub(crate) fn svg(&self) -> anyhow::Result<String> {
        let mut svg = String::new();
        self.draw(&mut svg).map_err(|e| anyhow!("cannot draw {}: {e}", self.caption))?;
        Ok(svg)
    }

    fn points<'s>(&'s self, series: &'s Series) -> impl Iterator<Item = (f64, f64)> + Clone + 's {
        series.points.iter().map(|&(x, y)| (self.x.to(x), self.y.to(y)))
    }

    fn draw(&self, svg: &mut String) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        let root = SVGBackend::with_string(svg, (900, 560)).into_drawing_area();
        root.fill(&WHITE)?;
        let of = |levels| self.series.iter().filter(move |s| levels || s.look != Look::Level);
        let x = self.x.range(of(false).flat_map(|s| self.points(s)).map(|p| p.0));
        let y = self.y.range(of(true).flat_map(|s| self.points(s)).map(|p| p.1));
        let mut chart = ChartBuilder::on(&root)
            .caption(&self.caption, ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(60)
            .build_cartesian_2d(x.clone(), y)?;
        chart
            .configure_mesh()
            .x_desc(self.x.label)
            .y_desc(self.y.label)
            .x_label_formatter(&|v| self.x.text(*v))
            .y_label_formatter(&|v| self.y.text(*v))
            .light_line_style(TRANSPARENT)
            .draw()?;
        for (i, series) in self.series.iter().enumerate() {
            let color = match series.look {
                Look::Front => BLACK.to_rgba(),
                _ => COLORS[i / self.shades % COLORS.len()]
                    .mix(1.0 - 0.8 * (i % self.shades) as f64 / self.shades as f64),
            };
            let points = self.points(series);
            let drawn = match series.look {
                Look::Curve => {
                    chart.draw_series(points.clone().map(|p| Circle::new(p, 3, color.filled())))?;
                    chart.draw_series(LineSeries::new(points, color.stroke_width(1)))?
                }
                Look::Front => chart.draw_series(LineSeries::new(points, color.stroke_width(2)))?,
                Look::Marks => chart.draw_series(points.map(|p| Circle::new(p, 7, color.stroke_width(2))))?,
                Look::Level => {
                    let level = points.map(|p| p.1).next().unwrap_or(f64::NAN);
                    chart.draw_series(LineSeries::new([(x.start, level), (x.end, level)], color.mix(0.6)))?
                }
            };
            drawn
                .label(&series.name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
        }
        chart
            .configure_series_labels()
            .position(self.legend.clone())
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK)
            .draw()?;
        root.present()?;
        Ok(())
    }
}
