// Written by engines/generate.py from the contract's dataclasses: `make generate` writes it anew.
using System;
using System.Collections.Generic;

namespace Ultragray
{
    /// <summary>The words of each enum in JSON.</summary>
    static class Words
    {
        internal static readonly string[] Below = { "refuse", "mask" };
        internal static readonly string[] Contact = { "air", "pressure" };
        internal static readonly string[] ToolFrame = { "scene", "probe" };
        internal static readonly string[] Speckle = { "off", "natural" };
        internal static readonly string[] PixelEncoding = { "uint8", "float32", "float16", "png", "jpeg", "npz" };
    }

    /// <summary>A probe is its scan lines. A kind is a class: numbers, and the bundle of lines that they mean.</summary>
    public abstract class Probe : IWritable, IReadable
    {
        public abstract string Kind { get; }
        public abstract void Write(JsonWriter json);
        public abstract void Read(JsonReader json);
        internal static readonly Func<JsonReader, Probe, Probe> ReadOne = Read;
        internal static Probe Read(JsonReader json, Probe current)
        {
            if (json.IsNull()) return null;
            string kind = json.PeekText("kind", current?.Kind);
            var it = current != null && current.Kind == kind ? current : Make(kind);
            it.Read(json);
            return it;
        }
        static Probe Make(string kind)
        {
            switch (kind)
            {
                case "convex": return new ConvexProbe();
                case "linear": return new LinearProbe();
                case "phased": return new PhasedProbe();
                case "radial": return new RadialProbe();
                case "steered": return new SteeredProbe();
                default: throw new FormatException("this client knows no probe of the kind " + kind);
            }
        }
    }

    /// <summary>A curved array: scan lines fan out from the apex, which is the origin.</summary>
    public sealed class ConvexProbe : Probe
    {
        /// <summary>Full angle of the fan.</summary>
        public double OpeningAngleDeg { get; set; }
        /// <summary>Radius of the face: distance from the apex at which the image begins.</summary>
        public double NearMm { get; set; }
        /// <summary>Distance from the apex at which the image ends, beyond `near_mm`.</summary>
        public double FarMm { get; set; }
        public override string Kind => "convex";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("opening_angle_deg", OpeningAngleDeg);
            json.Member("near_mm", NearMm);
            json.Member("far_mm", FarMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("opening_angle_deg")) OpeningAngleDeg = json.Number();
                else if (json.Named("near_mm")) NearMm = json.Number();
                else if (json.Named("far_mm")) FarMm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>A linear array: parallel scan lines along +z, the face centred on the origin.</summary>
    public sealed class LinearProbe : Probe
    {
        /// <summary>Width of the face.</summary>
        public double WidthMm { get; set; }
        /// <summary>Depth at which the image begins.</summary>
        public double NearMm { get; set; }
        /// <summary>Depth at which the image ends, beyond `near_mm`.</summary>
        public double FarMm { get; set; }
        public override string Kind => "linear";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("width_mm", WidthMm);
            json.Member("near_mm", NearMm);
            json.Member("far_mm", FarMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("width_mm")) WidthMm = json.Number();
                else if (json.Named("near_mm")) NearMm = json.Number();
                else if (json.Named("far_mm")) FarMm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>A phased array: scan lines fan out from the centre of the face; `near_mm` is 0.</summary>
    public sealed class PhasedProbe : Probe
    {
        /// <summary>Full angle of the fan.</summary>
        public double OpeningAngleDeg { get; set; }
        /// <summary>Depth at which the image ends.</summary>
        public double FarMm { get; set; }
        public override string Kind => "phased";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("opening_angle_deg", OpeningAngleDeg);
            json.Member("far_mm", FarMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("opening_angle_deg")) OpeningAngleDeg = json.Number();
                else if (json.Named("far_mm")) FarMm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>Scan lines all the way round in the image plane, outwards from a ring about the origin.</summary>
    public sealed class RadialProbe : Probe
    {
        /// <summary>Radius of the ring: distance from the centre at which the image begins.</summary>
        public double NearMm { get; set; }
        /// <summary>Distance from the centre at which the image ends, beyond `near_mm`.</summary>
        public double FarMm { get; set; }
        public override string Kind => "radial";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("near_mm", NearMm);
            json.Member("far_mm", FarMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("near_mm")) NearMm = json.Number();
                else if (json.Named("far_mm")) FarMm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>A linear array whose scan lines, parallel, leave the face at an angle; depths are along the lines.</summary>
    public sealed class SteeredProbe : Probe
    {
        /// <summary>Width of the face.</summary>
        public double WidthMm { get; set; }
        /// <summary>Angle of the scan lines from the axial axis, positive towards +x.</summary>
        public double SteeringDeg { get; set; }
        /// <summary>Depth along the scan lines at which the image begins.</summary>
        public double NearMm { get; set; }
        /// <summary>Depth along the scan lines at which the image ends, beyond `near_mm`.</summary>
        public double FarMm { get; set; }
        public override string Kind => "steered";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("width_mm", WidthMm);
            json.Member("steering_deg", SteeringDeg);
            json.Member("near_mm", NearMm);
            json.Member("far_mm", FarMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("width_mm")) WidthMm = json.Number();
                else if (json.Named("steering_deg")) SteeringDeg = json.Number();
                else if (json.Named("near_mm")) NearMm = json.Number();
                else if (json.Named("far_mm")) FarMm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>The fate of a frame whose confidence is below the limit.</summary>
    public enum Below
    {
        Refuse, Mask
    }

    /// <summary>What a frame shows of the probe's contact with the skin (`ultragray.rendering.contact`).</summary>
    public enum Contact
    {
        Air, Pressure
    }

    /// <summary>A rigid body in the image. It reflects as a mirror does, and a little to all sides, and it stops the beam.</summary>
    public abstract class Tool : IWritable, IReadable
    {
        public abstract string Kind { get; }
        public abstract void Write(JsonWriter json);
        public abstract void Read(JsonReader json);
        internal static readonly Func<JsonReader, Tool, Tool> ReadOne = Read;
        internal static Tool Read(JsonReader json, Tool current)
        {
            if (json.IsNull()) return null;
            string kind = json.PeekText("kind", current?.Kind);
            var it = current != null && current.Kind == kind ? current : Make(kind);
            it.Read(json);
            return it;
        }
        static Tool Make(string kind)
        {
            switch (kind)
            {
                case "box": return new Box();
                case "cylinder": return new Cylinder();
                case "needle": return new Needle();
                default: throw new FormatException("this client knows no tool of the kind " + kind);
            }
        }
    }

    /// <summary>The frame that the points of a tool are in.</summary>
    public enum ToolFrame
    {
        Scene, Probe
    }

    /// <summary>A solid box about a point, turned about it.</summary>
    public sealed class Box : Tool
    {
        /// <summary>Of its points; probe: it moves with the probe.</summary>
        public ToolFrame Frame { get; set; } = ToolFrame.Scene;
        /// <summary>Echo where a scan line meets it head on.</summary>
        public double Brightness { get; set; } = 1.0;
        /// <summary>Share of the brightness that is left at any angle.</summary>
        public double Roughness { get; set; } = 0.25;
        /// <summary>Strength of the first echo of its comet tail, of which each further one has the same share; 0: no tail.</summary>
        public double Reverberation { get; set; } = 0.4;
        /// <summary>Share of the beam that it stops where it is met head on.</summary>
        public double Opacity { get; set; } = 0.6;
        /// <summary>Of its pixels in the output labels.</summary>
        public long Label { get; set; } = 255;
        /// <summary>x, y and z of its middle.</summary>
        public double[] CentreMm { get; set; }
        /// <summary>w, x, y and z of the rotation from the box to its frame.</summary>
        public double[] Quaternion { get; set; } = { 1.0, 0.0, 0.0, 0.0 };
        /// <summary>Lengths along its own x, y and z.</summary>
        public double[] SizeMm { get; set; }
        public override string Kind => "box";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("frame", Words.ToolFrame[(int)Frame]);
            json.Member("brightness", Brightness);
            json.Member("roughness", Roughness);
            json.Member("reverberation", Reverberation);
            json.Member("opacity", Opacity);
            json.Member("label", Label);
            json.Member("centre_mm", CentreMm);
            json.Member("quaternion", Quaternion);
            json.Member("size_mm", SizeMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("frame")) Frame = (ToolFrame)json.Word(Words.ToolFrame);
                else if (json.Named("brightness")) Brightness = json.Number();
                else if (json.Named("roughness")) Roughness = json.Number();
                else if (json.Named("reverberation")) Reverberation = json.Number();
                else if (json.Named("opacity")) Opacity = json.Number();
                else if (json.Named("label")) Label = json.Integer();
                else if (json.Named("centre_mm")) CentreMm = json.Numbers(CentreMm);
                else if (json.Named("quaternion")) Quaternion = json.Numbers(Quaternion);
                else if (json.Named("size_mm")) SizeMm = json.Numbers(SizeMm);
                else json.Skip();
            }
        }
    }

    /// <summary>A solid cylinder with flat ends, thicker than the beam: its near side is seen. What is thinner is a needle.</summary>
    public sealed class Cylinder : Tool
    {
        /// <summary>Of its points; probe: it moves with the probe.</summary>
        public ToolFrame Frame { get; set; } = ToolFrame.Scene;
        /// <summary>Echo where a scan line meets it head on.</summary>
        public double Brightness { get; set; } = 1.0;
        /// <summary>Share of the brightness that is left at any angle.</summary>
        public double Roughness { get; set; } = 0.25;
        /// <summary>Strength of the first echo of its comet tail, of which each further one has the same share; 0: no tail.</summary>
        public double Reverberation { get; set; } = 0.4;
        /// <summary>Share of the beam that it stops where it is met head on.</summary>
        public double Opacity { get; set; } = 0.6;
        /// <summary>Of its pixels in the output labels.</summary>
        public long Label { get; set; } = 255;
        /// <summary>x, y and z of the tip.</summary>
        public double[] TipMm { get; set; }
        /// <summary>x, y and z of the other end.</summary>
        public double[] HubMm { get; set; }
        /// <summary>Diameter; 0.7 is 22 gauge.</summary>
        public double DiameterMm { get; set; } = 0.7;
        public override string Kind => "cylinder";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("frame", Words.ToolFrame[(int)Frame]);
            json.Member("brightness", Brightness);
            json.Member("roughness", Roughness);
            json.Member("reverberation", Reverberation);
            json.Member("opacity", Opacity);
            json.Member("label", Label);
            json.Member("tip_mm", TipMm);
            json.Member("hub_mm", HubMm);
            json.Member("diameter_mm", DiameterMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("frame")) Frame = (ToolFrame)json.Word(Words.ToolFrame);
                else if (json.Named("brightness")) Brightness = json.Number();
                else if (json.Named("roughness")) Roughness = json.Number();
                else if (json.Named("reverberation")) Reverberation = json.Number();
                else if (json.Named("opacity")) Opacity = json.Number();
                else if (json.Named("label")) Label = json.Integer();
                else if (json.Named("tip_mm")) TipMm = json.Numbers(TipMm);
                else if (json.Named("hub_mm")) HubMm = json.Numbers(HubMm);
                else if (json.Named("diameter_mm")) DiameterMm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>A straight needle. Its echo lies on the line from tip to hub, so that the tip is where it is said to be.</summary>
    public sealed class Needle : Tool
    {
        /// <summary>Of its points; probe: it moves with the probe.</summary>
        public ToolFrame Frame { get; set; } = ToolFrame.Scene;
        /// <summary>Echo where a scan line meets it head on.</summary>
        public double Brightness { get; set; } = 1.0;
        /// <summary>Share of the brightness that is left at any angle.</summary>
        public double Roughness { get; set; } = 0.25;
        /// <summary>Strength of the first echo of its comet tail, of which each further one has the same share; 0: no tail.</summary>
        public double Reverberation { get; set; } = 0.4;
        /// <summary>Share of the beam that it stops where it is met head on.</summary>
        public double Opacity { get; set; } = 0.6;
        /// <summary>Of its pixels in the output labels.</summary>
        public long Label { get; set; } = 255;
        /// <summary>x, y and z of the tip.</summary>
        public double[] TipMm { get; set; }
        /// <summary>x, y and z of the other end.</summary>
        public double[] HubMm { get; set; }
        /// <summary>Diameter; 0.7 is 22 gauge.</summary>
        public double DiameterMm { get; set; } = 0.7;
        public override string Kind => "needle";
        public override void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("kind", Kind);
            json.Member("frame", Words.ToolFrame[(int)Frame]);
            json.Member("brightness", Brightness);
            json.Member("roughness", Roughness);
            json.Member("reverberation", Reverberation);
            json.Member("opacity", Opacity);
            json.Member("label", Label);
            json.Member("tip_mm", TipMm);
            json.Member("hub_mm", HubMm);
            json.Member("diameter_mm", DiameterMm);
            json.Close('}');
        }
        public override void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("frame")) Frame = (ToolFrame)json.Word(Words.ToolFrame);
                else if (json.Named("brightness")) Brightness = json.Number();
                else if (json.Named("roughness")) Roughness = json.Number();
                else if (json.Named("reverberation")) Reverberation = json.Number();
                else if (json.Named("opacity")) Opacity = json.Number();
                else if (json.Named("label")) Label = json.Integer();
                else if (json.Named("tip_mm")) TipMm = json.Numbers(TipMm);
                else if (json.Named("hub_mm")) HubMm = json.Numbers(HubMm);
                else if (json.Named("diameter_mm")) DiameterMm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>Regular breathing by the service's clock: the number of the first mode goes from end to end and back.</summary>
    public sealed class Breathing : IWritable
    {
        /// <summary>Of one breath.</summary>
        public double PeriodS { get; set; } = 4.0;
        /// <summary>Share of the range that was seen, from its low end.</summary>
        public double Depth { get; set; } = 1.0;
        public void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("period_s", PeriodS);
            json.Member("depth", Depth);
            json.Close('}');
        }
    }

    /// <summary>The speckle of a frame (`ultragray.rendering.speckle`).</summary>
    public enum Speckle
    {
        Off, Natural
    }

    /// <summary>Settings of a display. The defaults show frames as they are.</summary>
    public sealed class DisplaySettings : IWritable, IReadable
    {
        /// <summary>Added to every echo.</summary>
        public double GainDb { get; set; }
        /// <summary>From white down to black.</summary>
        public double DynamicRangeDb { get; set; } = 60.0;
        /// <summary>Gains at evenly spaced depths from the first row shown to the last, linear in between.</summary>
        public double[] TgcDb { get; set; }
        /// <summary>Deeper rows, counted from the face, are cut off.</summary>
        public double? DepthMm { get; set; }
        /// <summary>Left and right change places.</summary>
        public bool Flip { get; set; }
        /// <summary>Scan conversion to square pixels of this size.</summary>
        public double? PixelMm { get; set; }
        /// <summary>Edge enhancement: how much of what a blur over 3x3 samples takes away is added.</summary>
        public double Edge { get; set; }
        /// <summary>Two numbers between which the gain of each frame is drawn at random, instead of gain_db.</summary>
        public double[] GainDbBetween { get; set; }
        /// <summary>Two numbers between which the dynamic range of each frame is drawn at random, instead of dynamic_range_db.</summary>
        public double[] DynamicRangeDbBetween { get; set; }
        /// <summary>Of what is drawn at random: the same seed and pose are the same frame, at every door.</summary>
        public long DisplaySeed { get; set; }
        public void Write(JsonWriter json)
        {
            json.Open('{');
            json.Member("gain_db", GainDb);
            json.Member("dynamic_range_db", DynamicRangeDb);
            json.Member("tgc_db", TgcDb);
            json.Member("depth_mm", DepthMm);
            json.Member("flip", Flip);
            json.Member("pixel_mm", PixelMm);
            json.Member("edge", Edge);
            json.Member("gain_db_between", GainDbBetween);
            json.Member("dynamic_range_db_between", DynamicRangeDbBetween);
            json.Member("display_seed", DisplaySeed);
            json.Close('}');
        }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("gain_db")) GainDb = json.Number();
                else if (json.Named("dynamic_range_db")) DynamicRangeDb = json.Number();
                else if (json.Named("tgc_db")) TgcDb = json.Numbers(TgcDb);
                else if (json.Named("depth_mm")) DepthMm = json.NumberOrNull();
                else if (json.Named("flip")) Flip = json.Flag();
                else if (json.Named("pixel_mm")) PixelMm = json.NumberOrNull();
                else if (json.Named("edge")) Edge = json.Number();
                else if (json.Named("gain_db_between")) GainDbBetween = json.Numbers(GainDbBetween);
                else if (json.Named("dynamic_range_db_between")) DynamicRangeDbBetween = json.Numbers(DynamicRangeDbBetween);
                else if (json.Named("display_seed")) DisplaySeed = json.Integer();
                else json.Skip();
            }
        }
    }

    /// <summary>Settings of what is rendered, but for the scene and the poses. None: as the scene has it.</summary>
    public class FrameSettings
    {
        /// <summary>Depth samples. Default: as trained, else 512.</summary>
        public long? Height { get; set; }
        /// <summary>Scan lines. Default: as trained, else 512.</summary>
        public long? Width { get; set; }
        /// <summary>Instead of the scene's own.</summary>
        public Probe Probe { get; set; }
        /// <summary>What is below is refused, or masked.</summary>
        public double? MinConfidence { get; set; }
        /// <summary>mask: pixels of such frames that Gaussians do not support are 0.</summary>
        public Below BelowMinConfidence { get; set; } = Below.Refuse;
        /// <summary>Full width at half maximum along elevation at the focus of the scene's beam; 0: a plane. Default: as trained.</summary>
        public double? SliceThicknessMm { get; set; }
        /// <summary>air: scan lines whose face is off the skin are dark. pressure: and tissue gives way to a face that is pressed in, and to needles. Default: contact is assumed.</summary>
        public Contact? Contact { get; set; }
        /// <summary>How far the face is pressed in, with contact pressure. Default: as far as it lies beyond the skin of the training views.</summary>
        public double? IndentationMm { get; set; }
        /// <summary>Needles and the like in the image; labels then are there for every scene.</summary>
        public Tool[] Tools { get; set; }
        /// <summary>Second echo: share of what is heard beyond the first strong interface that is the mirror image of what lies before it. Default: 0.</summary>
        public double? Ghost { get; set; }
        /// <summary>Numbers of the scene's modes of motion, one each. Default: tissue is at rest.</summary>
        public double[] Phase { get; set; }
        /// <summary>The first mode breathes by the service's clock; frames tell the phase that they were drawn with.</summary>
        public Breathing Breathing { get; set; }
        /// <summary>natural: bmode has the speckle that scatterers in the tissue give a scanner's frames. Other outputs are as without.</summary>
        public Speckle Speckle { get; set; } = Speckle.Off;
        /// <summary>Gain, depth, scan conversion ...; default: as rendered.</summary>
        public DisplaySettings Display { get; set; }
        /// <summary>Some of bmode, echo, transmittance, coverage, attenuation, labels, uncertainty.</summary>
        public string[] Outputs { get; set; } = { "bmode" };
        internal void WriteFrameSettings(JsonWriter json)
        {
            json.Member("height", Height);
            json.Member("width", Width);
            json.Member("probe", Probe);
            json.Member("min_confidence", MinConfidence);
            json.Member("below_min_confidence", Words.Below[(int)BelowMinConfidence]);
            json.Member("slice_thickness_mm", SliceThicknessMm);
            json.Member("contact", Contact == null ? null : Words.Contact[(int)Contact.Value]);
            json.Member("indentation_mm", IndentationMm);
            json.Member("tools", Tools);
            json.Member("ghost", Ghost);
            json.Member("phase", Phase);
            json.Member("breathing", Breathing);
            json.Member("speckle", Words.Speckle[(int)Speckle]);
            json.Member("display", Display);
            json.Member("outputs", Outputs);
        }
    }

    /// <summary>The form that pixels come in.</summary>
    public enum PixelEncoding
    {
        Uint8, Float32, Float16, Png, Jpeg, Npz
    }

    /// <summary>Settings with an encoding, for doors where neither an Accept header nor a file format decides it.</summary>
    public sealed class RenderSettings : FrameSettings, IWritable
    {
        /// <summary>Form of the pixels.</summary>
        public PixelEncoding Encoding { get; set; } = PixelEncoding.Uint8;
        /// <summary>Name of the registration by which the poses lead into the scene: they are then flange to base, or marker to tracker. Default: they are probe to scene.</summary>
        public string Registration { get; set; }
        public void Write(JsonWriter json)
        {
            json.Open('{');
            WriteFrameSettings(json);
            json.Member("encoding", Words.PixelEncoding[(int)Encoding]);
            json.Member("registration", Registration);
            json.Close('}');
        }
    }

    /// <summary>The client's clock beside the service's, as it is when the answer is sent.</summary>
    public sealed class ClockOffset : IReadable
    {
        /// <summary>Client's time minus service's.</summary>
        public double OffsetMs { get; set; }
        /// <summary>The offset is off by no more: half of the fastest round trip, and the standard deviation of the fit.</summary>
        public double UncertaintyMs { get; set; }
        /// <summary>What the client's clock gains, microseconds a second.</summary>
        public double DriftPpm { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("offset_ms")) OffsetMs = json.Number();
                else if (json.Named("uncertainty_ms")) UncertaintyMs = json.Number();
                else if (json.Named("drift_ppm")) DriftPpm = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>Of one frame. None: the scene does not know its training views, has no model, or no coverage was given.</summary>
    public sealed class Extrapolation : IReadable
    {
        /// <summary>Distance to the nearest training views, a mean over the image.</summary>
        public double? DistanceMm { get; set; }
        /// <summary>Angle to them.</summary>
        public double? AngleDeg { get; set; }
        /// <summary>The MS-SSIM that a real frame at this pose is expected to have with the rendered one, 0 to 1.</summary>
        public double? Confidence { get; set; }
        /// <summary>Share of the pixels that Gaussians support: coverage of at least 0.3.</summary>
        public double? SupportedShare { get; set; }
        /// <summary>Share of the scan lines that have contact with the skin; none where contact is assumed.</summary>
        public double? ContactShare { get; set; }
        /// <summary>How far the face presses the tissue in, a mean over these lines; none without contact pressure. A frame with more than 0 shows tissue as it was not recorded.</summary>
        public double? IndentationMm { get; set; }
        /// <summary>Force of the face on the tissue, along its axis; none likewise.</summary>
        public double? ForceN { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("distance_mm")) DistanceMm = json.NumberOrNull();
                else if (json.Named("angle_deg")) AngleDeg = json.NumberOrNull();
                else if (json.Named("confidence")) Confidence = json.NumberOrNull();
                else if (json.Named("supported_share")) SupportedShare = json.NumberOrNull();
                else if (json.Named("contact_share")) ContactShare = json.NumberOrNull();
                else if (json.Named("indentation_mm")) IndentationMm = json.NumberOrNull();
                else if (json.Named("force_n")) ForceN = json.NumberOrNull();
                else json.Skip();
            }
        }
    }

    /// <summary>The grid of a picture [H, W].</summary>
    public sealed class Picture : IReadable
    {
        /// <summary>H.</summary>
        public long Height { get; set; }
        /// <summary>W.</summary>
        public long Width { get; set; }
        /// <summary>mm or deg.</summary>
        public string ColumnUnit { get; set; }
        /// <summary>Column and row of the centre of pixel (0, 0).</summary>
        public double[] First { get; set; }
        /// <summary>To the next column and row.</summary>
        public double[] Step { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("height")) Height = json.Integer();
                else if (json.Named("width")) Width = json.Integer();
                else if (json.Named("column_unit")) ColumnUnit = json.Text(ColumnUnit);
                else if (json.Named("first")) First = json.Numbers(First);
                else if (json.Named("step")) Step = json.Numbers(Step);
                else json.Skip();
            }
        }
    }

    /// <summary>How far ahead of its measured pose a frame is, and how wrong its pose is expected to be (root mean square).</summary>
    public sealed class Prediction : IReadable
    {
        /// <summary>From the time of the newest pose to that of the frame.</summary>
        public double AheadMs { get; set; }
        /// <summary>Of the position; null: too few poses have come to tell.</summary>
        public double? ErrorMm { get; set; }
        /// <summary>Of the rotation, likewise.</summary>
        public double? ErrorDeg { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("ahead_ms")) AheadMs = json.Number();
                else if (json.Named("error_mm")) ErrorMm = json.NumberOrNull();
                else if (json.Named("error_deg")) ErrorDeg = json.NumberOrNull();
                else json.Skip();
            }
        }
    }

    /// <summary>What a frame of a stream that gets real frames shows, and how far to trust it.</summary>
    public sealed class Preview : IReadable
    {
        /// <summary>From the newest real frame to the time of this one.</summary>
        public double RealAgeMs { get; set; }
        /// <summary>By the image since then, root mean square.</summary>
        public double MovedMm { get; set; }
        /// <summary>It is the late real frame itself: that came nearer to the truth than what is rendered.</summary>
        public bool IsReal { get; set; }
        /// <summary>Root mean square of grey values from 0 to 1, as of the last real frames when they came; null: too few have.</summary>
        public double? ExpectedError { get; set; }
        /// <summary>Correlation of the structures of the newest real frame and the scene's, -1 to 1.</summary>
        public double Agreement { get; set; }
        /// <summary>Confidence times agreement, 0 to 1; null: the scene knows no confidence.</summary>
        public double? Trust { get; set; }
        /// <summary>By which the scene was moved to where the real frames show it.</summary>
        public double OffsetMm { get; set; }
        /// <summary>Likewise.</summary>
        public double OffsetDeg { get; set; }
        /// <summary>The newest real frame is not of the scene there, also after a search about its pose.</summary>
        public bool Disagrees { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("real_age_ms")) RealAgeMs = json.Number();
                else if (json.Named("moved_mm")) MovedMm = json.Number();
                else if (json.Named("is_real")) IsReal = json.Flag();
                else if (json.Named("expected_error")) ExpectedError = json.NumberOrNull();
                else if (json.Named("agreement")) Agreement = json.Number();
                else if (json.Named("trust")) Trust = json.NumberOrNull();
                else if (json.Named("offset_mm")) OffsetMm = json.Number();
                else if (json.Named("offset_deg")) OffsetDeg = json.Number();
                else if (json.Named("disagrees")) Disagrees = json.Flag();
                else json.Skip();
            }
        }
    }

    /// <summary>The JSON before the pixels of a frame.</summary>
    public sealed class FrameHeader : IReadable
    {
        /// <summary>Of the message that it answers.</summary>
        public long Sequence { get; set; }
        /// <summary>Likewise.</summary>
        public double? ClientTimeMs { get; set; }
        /// <summary>Poses that newer ones replaced since the answer before.</summary>
        public long Dropped { get; set; }
        /// <summary>When it is sent, by the service's clock, since 1970.</summary>
        public double SentMs { get; set; }
        /// <summary>The client's clock beside the service's; null: not known yet.</summary>
        public ClockOffset Clock { get; set; }
        /// <summary>From client_time_ms, when the pose was measured, to sent_ms, across both clocks; null: not known.</summary>
        public double? AgeMs { get; set; }
        /// <summary>Name.</summary>
        public string Scene { get; set; }
        /// <summary>Of the scene file.</summary>
        public string SceneSha256 { get; set; }
        /// <summary>Name, version and backend of the renderer.</summary>
        public string Renderer { get; set; }
        /// <summary>Matrix as used.</summary>
        public double[][] Pose { get; set; }
        /// <summary>How far the frame lies from the training views.</summary>
        public Extrapolation Extrapolation { get; set; }
        /// <summary>Waiting time.</summary>
        public double QueueMs { get; set; }
        /// <summary>Of the batch that it was rendered in.</summary>
        public double RenderMs { get; set; }
        /// <summary>Encoding time.</summary>
        public double EncodeMs { get; set; }
        /// <summary>Below it the frame was refused, or masked; null: any.</summary>
        public double? MinConfidence { get; set; }
        /// <summary>mask: where the frame's confidence is below min_confidence, pixels without support are 0.</summary>
        public Below BelowMinConfidence { get; set; } = Below.Refuse;
        /// <summary>As used; null: it was assumed.</summary>
        public Contact? Contact { get; set; }
        /// <summary>As asked for; null: as the pose tells.</summary>
        public double? IndentationMm { get; set; }
        /// <summary>As used.</summary>
        public Tool[] Tools { get; set; }
        /// <summary>As used; 0: none.</summary>
        public double Ghost { get; set; }
        /// <summary>Numbers of the scene's modes of motion, as used; empty: at rest.</summary>
        public double[] Phase { get; set; }
        /// <summary>As used.</summary>
        public Speckle Speckle { get; set; } = Speckle.Off;
        /// <summary>That led the pose into the scene; null: none, it was sent as it is.</summary>
        public string Registration { get; set; }
        /// <summary>As used.</summary>
        public Probe Probe { get; set; }
        /// <summary>As used: at the focus of the scene's beam; 0: a plane.</summary>
        public double SliceThicknessMm { get; set; }
        /// <summary>Depth samples, before the display settings were applied.</summary>
        public long RenderedHeight { get; set; }
        /// <summary>Scan lines, likewise.</summary>
        public long RenderedWidth { get; set; }
        /// <summary>As used.</summary>
        public DisplaySettings Display { get; set; }
        /// <summary>H.</summary>
        public long Height { get; set; }
        /// <summary>W.</summary>
        public long Width { get; set; }
        /// <summary>Where the pixels lie.</summary>
        public Picture Picture { get; set; }
        /// <summary>In the order of the data.</summary>
        public string[] Outputs { get; set; }
        /// <summary>Of the pixels.</summary>
        public PixelEncoding Encoding { get; set; }
        /// <summary>How its pose was foretold; null: it is as it was sent.</summary>
        public Prediction Prediction { get; set; }
        /// <summary>How real frames of the stream corrected it; null: none did.</summary>
        public Preview Preview { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("sequence")) Sequence = json.Integer();
                else if (json.Named("client_time_ms")) ClientTimeMs = json.NumberOrNull();
                else if (json.Named("dropped")) Dropped = json.Integer();
                else if (json.Named("sent_ms")) SentMs = json.Number();
                else if (json.Named("clock")) Clock = json.Object(Clock);
                else if (json.Named("age_ms")) AgeMs = json.NumberOrNull();
                else if (json.Named("scene")) Scene = json.Text(Scene);
                else if (json.Named("scene_sha256")) SceneSha256 = json.Text(SceneSha256);
                else if (json.Named("renderer")) Renderer = json.Text(Renderer);
                else if (json.Named("pose")) Pose = json.Rows(Pose);
                else if (json.Named("extrapolation")) Extrapolation = json.Object(Extrapolation);
                else if (json.Named("queue_ms")) QueueMs = json.Number();
                else if (json.Named("render_ms")) RenderMs = json.Number();
                else if (json.Named("encode_ms")) EncodeMs = json.Number();
                else if (json.Named("min_confidence")) MinConfidence = json.NumberOrNull();
                else if (json.Named("below_min_confidence")) BelowMinConfidence = (Below)json.Word(Words.Below);
                else if (json.Named("contact")) Contact = json.IsNull() ? null : (Contact?)json.Word(Words.Contact);
                else if (json.Named("indentation_mm")) IndentationMm = json.NumberOrNull();
                else if (json.Named("tools")) Tools = json.Elements(Tools, Tool.ReadOne);
                else if (json.Named("ghost")) Ghost = json.Number();
                else if (json.Named("phase")) Phase = json.Numbers(Phase);
                else if (json.Named("speckle")) Speckle = (Speckle)json.Word(Words.Speckle);
                else if (json.Named("registration")) Registration = json.Text(Registration);
                else if (json.Named("probe")) Probe = Probe.Read(json, Probe);
                else if (json.Named("slice_thickness_mm")) SliceThicknessMm = json.Number();
                else if (json.Named("rendered_height")) RenderedHeight = json.Integer();
                else if (json.Named("rendered_width")) RenderedWidth = json.Integer();
                else if (json.Named("display")) Display = json.Object(Display);
                else if (json.Named("height")) Height = json.Integer();
                else if (json.Named("width")) Width = json.Integer();
                else if (json.Named("picture")) Picture = json.Object(Picture);
                else if (json.Named("outputs")) Outputs = json.Texts(Outputs);
                else if (json.Named("encoding")) Encoding = (PixelEncoding)json.Word(Words.PixelEncoding);
                else if (json.Named("prediction")) Prediction = json.Object(Prediction);
                else if (json.Named("preview")) Preview = json.Object(Preview);
                else json.Skip();
            }
        }
        internal static readonly string[] Texts = { "scene", "scene_sha256", "renderer", "below_min_confidence", "contact", "speckle", "registration", "encoding" };
        internal static readonly string[] TextLists = { "outputs" };
        internal static readonly string[] Others = { "sequence", "client_time_ms", "dropped", "sent_ms", "clock", "age_ms", "pose", "extrapolation", "queue_ms", "render_ms", "encode_ms", "min_confidence", "indentation_mm", "tools", "ghost", "phase", "probe", "slice_thickness_mm", "rendered_height", "rendered_width", "display", "height", "width", "picture", "prediction", "preview" };
    }

    /// <summary>An error where a call as a whole does not fail.</summary>
    public sealed class Refusal : IReadable
    {
        /// <summary>Stable, for programs.</summary>
        public string Reason { get; set; }
        /// <summary>One sentence for a person.</summary>
        public string Detail { get; set; }
        /// <summary>Path of the value to blame, null if none is.</summary>
        public string Field { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("reason")) Reason = json.Text(Reason);
                else if (json.Named("detail")) Detail = json.Text(Detail);
                else if (json.Named("field")) Field = json.Text(Field);
                else json.Skip();
            }
        }
    }

    /// <summary>The text message in place of a frame.</summary>
    public sealed class RefusalMessage : IReadable
    {
        /// <summary>Of the message that it answers.</summary>
        public long Sequence { get; set; }
        /// <summary>Likewise.</summary>
        public double? ClientTimeMs { get; set; }
        /// <summary>Poses that newer ones replaced since the answer before.</summary>
        public long Dropped { get; set; }
        /// <summary>When it is sent, by the service's clock, since 1970.</summary>
        public double SentMs { get; set; }
        /// <summary>The client's clock beside the service's; null: not known yet.</summary>
        public ClockOffset Clock { get; set; }
        /// <summary>From client_time_ms, when the pose was measured, to sent_ms, across both clocks; null: not known.</summary>
        public double? AgeMs { get; set; }
        public Refusal Error { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("sequence")) Sequence = json.Integer();
                else if (json.Named("client_time_ms")) ClientTimeMs = json.NumberOrNull();
                else if (json.Named("dropped")) Dropped = json.Integer();
                else if (json.Named("sent_ms")) SentMs = json.Number();
                else if (json.Named("clock")) Clock = json.Object(Clock);
                else if (json.Named("age_ms")) AgeMs = json.NumberOrNull();
                else if (json.Named("error")) Error = json.Object(Error);
                else json.Skip();
            }
        }
    }

    /// <summary>A point in the scene frame, mm.</summary>
    public sealed class Position : IReadable
    {
        public double X { get; set; }
        public double Y { get; set; }
        public double Z { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("x")) X = json.Number();
                else if (json.Named("y")) Y = json.Number();
                else if (json.Named("z")) Z = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>A box in the scene frame, mm.</summary>
    public sealed class SceneBounds : IReadable
    {
        public Position MinMm { get; set; }
        public Position MaxMm { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("min_mm")) MinMm = json.Object(MinMm);
                else if (json.Named("max_mm")) MaxMm = json.Object(MaxMm);
                else json.Skip();
            }
        }
    }

    /// <summary>A rotation from the probe to the scene, unit norm within 1e-3.</summary>
    public sealed class Rotation : IReadable
    {
        public double W { get; set; }
        public double X { get; set; }
        public double Y { get; set; }
        public double Z { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("w")) W = json.Number();
                else if (json.Named("x")) X = json.Number();
                else if (json.Named("y")) Y = json.Number();
                else if (json.Named("z")) Z = json.Number();
                else json.Skip();
            }
        }
    }

    /// <summary>A pose as a matrix (4x4, mm), and as position and rotation.</summary>
    public sealed class TrainingPose : IReadable
    {
        public double[][] Matrix { get; set; }
        public Position PositionMm { get; set; }
        public Rotation Quaternion { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("matrix")) Matrix = json.Rows(Matrix);
                else if (json.Named("position_mm")) PositionMm = json.Object(PositionMm);
                else if (json.Named("quaternion")) Quaternion = json.Object(Quaternion);
                else json.Skip();
            }
        }
    }

    /// <summary>The poses that the scene has seen; frames far from them extrapolate. Where there are none, all else is null.</summary>
    public sealed class TrainingPoses : IReadable
    {
        public long Count { get; set; }
        /// <summary>Of the probe's origin.</summary>
        public Position PositionMinMm { get; set; }
        public Position PositionMaxMm { get; set; }
        public TrainingPose First { get; set; }
        public TrainingPose Middle { get; set; }
        public TrainingPose Last { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("count")) Count = json.Integer();
                else if (json.Named("position_min_mm")) PositionMinMm = json.Object(PositionMinMm);
                else if (json.Named("position_max_mm")) PositionMaxMm = json.Object(PositionMaxMm);
                else if (json.Named("first")) First = json.Object(First);
                else if (json.Named("middle")) Middle = json.Object(Middle);
                else if (json.Named("last")) Last = json.Object(Last);
                else json.Skip();
            }
        }
    }

    /// <summary>A Gaussian beam across the image plane, with a focus (docs/physics.md §3).</summary>
    public sealed class ElevationBeam : IReadable
    {
        /// <summary>Thickness at the focus: full width at half maximum along elevation.</summary>
        public double ThicknessMm { get; set; }
        /// <summary>Depth of the focus below the probe's face; none: the same thickness at every depth.</summary>
        public double? FocusMm { get; set; }
        /// <summary>Depth over which it is at most √2 times as thick as at the focus: twice the Rayleigh range.</summary>
        public double? DepthOfFieldMm { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("thickness_mm")) ThicknessMm = json.Number();
                else if (json.Named("focus_mm")) FocusMm = json.NumberOrNull();
                else if (json.Named("depth_of_field_mm")) DepthOfFieldMm = json.NumberOrNull();
                else json.Skip();
            }
        }
    }

    /// <summary>How well a scene knows the confidence of its frames.</summary>
    public sealed class ConfidenceFit : IReadable
    {
        /// <summary>Mean absolute error of the confidence on the views it was fitted on.</summary>
        public double Error { get; set; }
        /// <summary>How many those are.</summary>
        public long FittedOn { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("error")) Error = json.Number();
                else if (json.Named("fitted_on")) FittedOn = json.Integer();
                else json.Skip();
            }
        }
    }

    /// <summary>One mode of motion, and the surrogate that tells its number.</summary>
    public sealed class Mode : IReadable
    {
        /// <summary>Such as breathing.</summary>
        public string Name { get; set; }
        /// <summary>Least number that a frame was seen with.</summary>
        public double Low { get; set; }
        /// <summary>Greatest number that a frame was seen with.</summary>
        public double High { get; set; }
        /// <summary>Number at which the tissue is where the scene has it.</summary>
        public double Rest { get; set; }
        /// <summary>Of the number; empty: it has none.</summary>
        public string Unit { get; set; }
        /// <summary>What told the number: a belt, a column of a file.</summary>
        public string Surrogate { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("name")) Name = json.Text(Name);
                else if (json.Named("low")) Low = json.Number();
                else if (json.Named("high")) High = json.Number();
                else if (json.Named("rest")) Rest = json.Number();
                else if (json.Named("unit")) Unit = json.Text(Unit);
                else if (json.Named("surrogate")) Surrogate = json.Text(Surrogate);
                else json.Skip();
            }
        }
    }

    /// <summary>The modes of a scene, and the grid that their fields have in common, along the axes of the scene.</summary>
    public sealed class Motion : IReadable
    {
        /// <summary>At least one.</summary>
        public Mode[] Modes { get; set; }
        /// <summary>The first spline.</summary>
        public double[] OriginMm { get; set; }
        /// <summary>Between splines.</summary>
        public double[] SpacingMm { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("modes")) Modes = json.Objects(Modes);
                else if (json.Named("origin_mm")) OriginMm = json.Numbers(OriginMm);
                else if (json.Named("spacing_mm")) SpacingMm = json.Numbers(SpacingMm);
                else json.Skip();
            }
        }
    }

    /// <summary>All that a scene says about itself; null where it is unknown.</summary>
    public sealed class SceneDetails : IReadable
    {
        public string Name { get; set; }
        /// <summary>By at least one render process.</summary>
        public bool Loaded { get; set; }
        /// <summary>How many render processes hold it.</summary>
        public long LoadedProcesses { get; set; }
        public long FileBytes { get; set; }
        public long GaussianCount { get; set; }
        public long ShDegree { get; set; }
        public string Intensity { get; set; }
        public Position CentreMm { get; set; }
        /// <summary>Of the Gaussians' means.</summary>
        public SceneBounds Bounds { get; set; }
        /// <summary>The one it was trained with.</summary>
        public Probe Probe { get; set; }
        public long? ImageHeight { get; set; }
        public long? ImageWidth { get; set; }
        public TrainingPoses TrainingPoses { get; set; }
        public Dictionary<string, double> Metrics { get; set; }
        public string DatasetName { get; set; }
        public string DatasetSha256 { get; set; }
        /// <summary>What can be rendered of it.</summary>
        public string[] Outputs { get; set; }
        /// <summary>What the values of the output labels mean; empty: it has none.</summary>
        public Dictionary<string, string> LabelNames { get; set; }
        /// <summary>Of the frames it was trained on; null: they are taken for planes.</summary>
        public ElevationBeam Beam { get; set; }
        /// <summary>null: the scene cannot tell the confidence of its frames.</summary>
        public ConfidenceFit Confidence { get; set; }
        /// <summary>Whether its frames can have natural speckle.</summary>
        public bool Speckle { get; set; }
        /// <summary>Modes by which its tissue moves; null: it is still.</summary>
        public Motion Motion { get; set; }
        /// <summary>Who imported or trained it; null: nobody.</summary>
        public string Owner { get; set; }
        /// <summary>Whether others may not see it.</summary>
        public bool Private { get; set; }
        /// <summary>SHA-256 by name of the scenes that edits made it of; empty: it was trained.</summary>
        public Dictionary<string, string> Parents { get; set; }
        /// <summary>What was done to them, each in JSON; `left_out`: what it did not keep.</summary>
        public string[] Edits { get; set; }
        /// <summary>Names of the labels of what was never recorded: put in, made or moved.</summary>
        public string[] MadeLabels { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("name")) Name = json.Text(Name);
                else if (json.Named("loaded")) Loaded = json.Flag();
                else if (json.Named("loaded_processes")) LoadedProcesses = json.Integer();
                else if (json.Named("file_bytes")) FileBytes = json.Integer();
                else if (json.Named("gaussian_count")) GaussianCount = json.Integer();
                else if (json.Named("sh_degree")) ShDegree = json.Integer();
                else if (json.Named("intensity")) Intensity = json.Text(Intensity);
                else if (json.Named("centre_mm")) CentreMm = json.Object(CentreMm);
                else if (json.Named("bounds")) Bounds = json.Object(Bounds);
                else if (json.Named("probe")) Probe = Probe.Read(json, Probe);
                else if (json.Named("image_height")) ImageHeight = json.IntegerOrNull();
                else if (json.Named("image_width")) ImageWidth = json.IntegerOrNull();
                else if (json.Named("training_poses")) TrainingPoses = json.Object(TrainingPoses);
                else if (json.Named("metrics")) Metrics = json.Map(JsonReader.ReadNumber);
                else if (json.Named("dataset_name")) DatasetName = json.Text(DatasetName);
                else if (json.Named("dataset_sha256")) DatasetSha256 = json.Text(DatasetSha256);
                else if (json.Named("outputs")) Outputs = json.Texts(Outputs);
                else if (json.Named("label_names")) LabelNames = json.Map(JsonReader.ReadText);
                else if (json.Named("beam")) Beam = json.Object(Beam);
                else if (json.Named("confidence")) Confidence = json.Object(Confidence);
                else if (json.Named("speckle")) Speckle = json.Flag();
                else if (json.Named("motion")) Motion = json.Object(Motion);
                else if (json.Named("owner")) Owner = json.Text(Owner);
                else if (json.Named("private")) Private = json.Flag();
                else if (json.Named("parents")) Parents = json.Map(JsonReader.ReadText);
                else if (json.Named("edits")) Edits = json.Texts(Edits);
                else if (json.Named("made_labels")) MadeLabels = json.Texts(MadeLabels);
                else json.Skip();
            }
        }
    }

    /// <summary>A scene in the list. A file that cannot be read has `error`, and null for what is in the file.</summary>
    public sealed class SceneEntry : IReadable
    {
        public string Name { get; set; }
        /// <summary>By at least one render process.</summary>
        public bool Loaded { get; set; }
        /// <summary>Whether it may be deleted: scenes of the data folder may not.</summary>
        public bool Removable { get; set; }
        public long? GaussianCount { get; set; }
        public long? ImageHeight { get; set; }
        public long? ImageWidth { get; set; }
        public long? FileBytes { get; set; }
        public Refusal Error { get; set; }
        /// <summary>Who imported or trained it; null: nobody.</summary>
        public string Owner { get; set; }
        /// <summary>Whether others may not see it.</summary>
        public bool Private { get; set; }
        /// <summary>Of the probe it was trained with, such as convex; null: not known.</summary>
        public string ProbeKind { get; set; }
        /// <summary>Of the training, on held-out frames.</summary>
        public Dictionary<string, double> Metrics { get; set; }
        /// <summary>When its file was last written, ISO 8601, UTC; null: not known.</summary>
        public string ChangedAt { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("name")) Name = json.Text(Name);
                else if (json.Named("loaded")) Loaded = json.Flag();
                else if (json.Named("removable")) Removable = json.Flag();
                else if (json.Named("gaussian_count")) GaussianCount = json.IntegerOrNull();
                else if (json.Named("image_height")) ImageHeight = json.IntegerOrNull();
                else if (json.Named("image_width")) ImageWidth = json.IntegerOrNull();
                else if (json.Named("file_bytes")) FileBytes = json.IntegerOrNull();
                else if (json.Named("error")) Error = json.Object(Error);
                else if (json.Named("owner")) Owner = json.Text(Owner);
                else if (json.Named("private")) Private = json.Flag();
                else if (json.Named("probe_kind")) ProbeKind = json.Text(ProbeKind);
                else if (json.Named("metrics")) Metrics = json.Map(JsonReader.ReadNumber);
                else if (json.Named("changed_at")) ChangedAt = json.Text(ChangedAt);
                else json.Skip();
            }
        }
    }

    /// <summary>One page of scenes by name.</summary>
    public sealed class ScenePage : IReadable
    {
        public SceneEntry[] Scenes { get; set; }
        /// <summary>Empty on the last page.</summary>
        public string NextPageToken { get; set; }
        public void Read(JsonReader json)
        {
            if (!json.Enter('{')) return;
            while (json.NextMember())
            {
                if (json.Named("scenes")) Scenes = json.Objects(Scenes);
                else if (json.Named("next_page_token")) NextPageToken = json.Text(NextPageToken);
                else json.Skip();
            }
        }
    }
}
