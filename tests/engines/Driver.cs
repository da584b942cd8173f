// What the tests of the C# client do, by lines: `ask X Y Z`, `set HEIGHT WIDTH ENCODING OUTPUTS GAIN`, `rest`, and the end of the input ends it.
// Frames are told as they come: `frame SEQUENCE HEIGHT WIDTH CONFIDENCE SHA256`, and what is wrong when it changes: `problem SENTENCE`.

using System;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Security.Cryptography;
using System.Text;
using System.Threading;
using Ultragray;

static class Driver
{
    static int Main(string[] words)
    {
        CultureInfo.CurrentCulture = CultureInfo.InvariantCulture;
        switch (words[0])
        {
            case "frames": return Frames(Open(words));
            case "many": return Many(Open(words), int.Parse(words.Last()));
            case "service": return OfService(new Service(words[1], words.ElementAtOrDefault(2)));
            case "again": return Again(Console.In.ReadToEnd());
            case "pose": return Converted(words.Skip(1).Select(float.Parse).ToArray());
            default: throw new ArgumentException(words[0]);
        }
    }

    static readonly SemaphoreSlim rest = new SemaphoreSlim(0); // `rest`: what was kept back of a file may come

    /// `remote URL SCENE KEY`, `local FILE` or `arriving FILE BYTES`, of which so many come at once: what changes between them is this.
    static IFrameSource Open(string[] words)
    {
        if (words[1] == "remote") return new Service(words[2], words.ElementAtOrDefault(4)).Stream(words[3], null, "driver");
        return new LocalFrames(() => words[1] == "local" ? File.OpenRead(words[2]) : (Stream)new Arriving(words[2], int.Parse(words[3])));
    }

    sealed class Arriving : MemoryStream
    {
        readonly int first;

        internal Arriving(string file, int first) : base(File.ReadAllBytes(file))
        {
            this.first = first;
        }

        public override int Read(byte[] buffer, int offset, int count)
        {
            if (Position == first) rest.Wait();
            return base.Read(buffer, offset, Position < first ? (int)Math.Min(count, first - Position) : count);
        }
    }

    static int Frames(IFrameSource source)
    {
        bool isOver = false;
        var reader = new Thread(() =>
        {
            string line;
            while ((line = Console.In.ReadLine()) != null)
            {
                var words = line.Split(' ');
                if (words[0] == "ask")
                {
                    var pose = words.Skip(1).Select(double.Parse).ToArray();
                    source.Ask(pose.Length == 3 ? ProbePose.At(pose[0], pose[1], pose[2]) : new ProbePose(pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6]));
                }
                else if (words[0] == "rest") rest.Release();
                else source.Settings = new RenderSettings
                {
                    Height = long.Parse(words[1]),
                    Width = long.Parse(words[2]),
                    Encoding = (PixelEncoding)Enum.Parse(typeof(PixelEncoding), words[3]),
                    Outputs = words[4].Split(','),
                    Display = new DisplaySettings { GainDb = double.Parse(words[5]) },
                };
            }
            Volatile.Write(ref isOver, true);
        });
        reader.IsBackground = true;
        reader.Start();
        Frame frame = null;
        string told = null;
        (source as LocalFrames)?.Whole.ContinueWith(whole => Console.WriteLine("whole " + whole.Exception?.GetBaseException().Message));
        while (!Volatile.Read(ref isOver))
        {
            string problem = source.Problem;
            if (problem != told) Console.WriteLine(problem == null ? "well" : "problem " + problem);
            told = problem;
            if (source.Take(ref frame)) Console.WriteLine("frame " + frame.Header.Sequence + " " + Told(frame));
            else Thread.Sleep(1);
        }
        source.Dispose();
        (source as LocalFrames)?.Join();
        (source as FrameStream)?.Ended.Wait();
        return 0;
    }

    static string Told(Frame frame)
    {
        var pixels = frame.Header.Outputs.Select(one => frame.Pixels(one)).ToArray();
        int from = pixels[0].Offset, to = pixels.Last().Offset + pixels.Last().Count;
        using (var sha = SHA256.Create())
        {
            var sum = sha.ComputeHash(pixels[0].Array, from, to - from);
            return frame.Height + " " + frame.Width + " " + (frame.Confidence?.ToString("R") ?? "-") + " " + Hex(sum);
        }
    }

    static string Hex(byte[] bytes)
    {
        return BitConverter.ToString(bytes).Replace("-", "").ToLowerInvariant();
    }

    /// Takes so many frames. Tells, for the second and the last tenth, what the process holds, and what this thread left as garbage.
    static int Many(IFrameSource source, int count)
    {
        Frame frame = null;
        long garbage = 0;
        for (int taken = 0; taken < count;)
        {
            long before = GC.GetAllocatedBytesForCurrentThread();
            source.Ask(ProbePose.At(0.01 * (taken % 100), 0, 0));
            bool has;
            while (!(has = source.Take(ref frame)) && source.Problem == null) Thread.Sleep(0);
            if (taken >= count / 10) garbage += GC.GetAllocatedBytesForCurrentThread() - before;
            if (!has) throw new Exception(source.Problem);
            taken++;
            if (taken == count / 5 || taken == count) TellOfProcess(taken, garbage);
        }
        source.Dispose();
        (source as LocalFrames)?.Join();
        (source as FrameStream)?.Ended.Wait();
        return 0;
    }

    static void TellOfProcess(int taken, long garbage)
    {
        GC.Collect();
        GC.WaitForPendingFinalizers();
        long held = GC.GetTotalMemory(true);
        int handles = Directory.GetFiles("/proc/self/fd").Length, threads = Directory.GetDirectories("/proc/self/task").Length;
        string resident = File.ReadAllText("/proc/self/statm").Split(' ')[1];
        Console.WriteLine("held " + taken + " " + held + " " + resident + " " + handles + " " + threads + " " + garbage);
    }

    static int OfService(Service service)
    {
        try
        {
            Console.WriteLine("scenes " + string.Join(" ", service.SceneNames().Result));
            var scene = service.Scene("demo").Result;
            Console.WriteLine("scene " + scene.GaussianCount + " " + scene.Probe.Kind + " " + ((LinearProbe)scene.Probe).WidthMm + " " + scene.TrainingPoses.Count);
            using (var sha = SHA256.Create()) Console.WriteLine("file " + Hex(sha.ComputeHash(service.Download("demo").Result)));
            var settings = new RenderSettings { Height = 40, Outputs = new[] { "bmode", "coverage" }, Encoding = PixelEncoding.Float32 };
            settings.Tools = new Tool[] { new Needle { TipMm = new double[] { 0, 0, 20 }, HubMm = new double[] { -20, 0, 5 }, Frame = ToolFrame.Probe } };
            var frame = service.Render("demo", ProbePose.Of(scene.TrainingPoses.Middle), settings).Result;
            Console.WriteLine("frame " + string.Join(",", frame.Header.Outputs) + " " + Told(frame));
            var png = service.Render("demo", ProbePose.At(0, 0, 0), new RenderSettings { Encoding = PixelEncoding.Png }).Result;
            Console.WriteLine("png " + Encoding.ASCII.GetString(png.Data.Array, png.Data.Offset + 1, 3) + " " + png.Header.Encoding);
            service.Scene("söme \"other").Wait();
        }
        catch (AggregateException error)
        {
            var refusal = error.GetBaseException() as ServiceException;
            Console.WriteLine("refused " + refusal?.Reason + " " + refusal?.Field + " " + error.GetBaseException().Message);
        }
        return 0;
    }

    /// Reads a frame's header twice into the same object, and writes the settings that it tells.
    static int Again(string text)
    {
        var header = new FrameHeader();
        var reader = new JsonReader(Encoding.UTF8.GetBytes(text));
        header.Read(reader);
        object[] held = { header.Probe, header.Renderer, header.Pose, header.Display, header.Outputs, header.Tools };
        reader.Begin(Encoding.UTF8.GetBytes(text), 0, Encoding.UTF8.GetByteCount(text));
        header.Read(reader);
        object[] now = { header.Probe, header.Renderer, header.Pose, header.Display, header.Outputs, header.Tools };
        if (!held.Zip(now, ReferenceEquals).All(same => same)) throw new Exception("what has not changed was read anew");
        var settings = new RenderSettings
        {
            Height = header.RenderedHeight,
            Width = header.RenderedWidth,
            Probe = header.Probe,
            MinConfidence = header.MinConfidence,
            BelowMinConfidence = header.BelowMinConfidence,
            SliceThicknessMm = header.SliceThicknessMm,
            Contact = header.Contact,
            Tools = header.Tools,
            Ghost = header.Ghost,
            Speckle = header.Speckle,
            Display = header.Display,
            Outputs = header.Outputs,
            Encoding = header.Encoding,
            Registration = header.Registration,
        };
        var written = JsonWriter.Text(settings);
        Console.WriteLine(Encoding.UTF8.GetString(written, 0, written.Length - 1));
        return 0;
    }

    /// A position and a quaternion as Unity has them: as the matrix of the scene, row by row, and back.
    static int Converted(float[] of)
    {
        var pose = ProbePose.FromUnity(of[0], of[1], of[2], of[3], of[4], of[5], of[6]);
        var matrix = new double[16];
        pose.CopyTo(matrix);
        Console.WriteLine(string.Join(" ", matrix.Select(one => one.ToString("R"))));
        var back = new float[7];
        pose.ToUnity(out back[0], out back[1], out back[2], out back[3], out back[4], out back[5], out back[6]);
        Console.WriteLine(string.Join(" ", back.Select(one => one.ToString("R"))));
        return 0;
    }
}
