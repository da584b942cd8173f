using System;
using System.IO;
using System.Runtime.InteropServices;
using System.Text;
using System.Threading;
using System.Threading.Tasks;

namespace Ultragray
{
    /// <summary>
    /// Frames that this machine renders itself, by libultragray (ultragray.h): no service, no network. One thread loads the scene,
    /// another renders the newest pose. A compressed file (.ugz) is a scene as soon as its first part is there, and becomes finer as
    /// the others arrive.
    /// </summary>
    public sealed class LocalFrames : IFrameSource
    {
        readonly Exchange exchange = new Exchange();
        readonly int threads;
        readonly Thread renderer;
        SceneHandle arrived; // since the renderer looked; null: none
        volatile bool isDisposed;

        /// <summary>`open` gives a scene file, such as () => File.OpenRead("demo.ugz").</summary>
        public LocalFrames(Func<Stream> open, RenderSettings settings = null, int threads = 1)
        {
            this.threads = threads;
            exchange.Set(settings);
            Whole = Task.Factory.StartNew(() => Load(open), TaskCreationOptions.LongRunning);
            renderer = new Thread(Render) { IsBackground = true, Name = "ultragray" };
            renderer.Start();
        }

        /// <summary>When frames are those of the whole file. Fails, in a sentence, where the rest of it is damaged or does not come.</summary>
        public Task Whole { get; }

        public string Problem => exchange.Problem;

        public RenderSettings Settings
        {
            set { exchange.Set(value); }
        }

        public void Ask(ProbePose pose) => exchange.Ask(pose);

        public bool Take(ref Frame frame) => exchange.Take(ref frame);

        /// <summary>Ends it, without waiting: the scene is freed after the frame that is rendered, and the part that is read.</summary>
        public void Dispose()
        {
            lock (exchange) isDisposed = true;
            exchange.Pulse();
        }

        /// <summary>Waits until the scene is freed, after Dispose.</summary>
        public void Join() => renderer.Join();

        void Load(Func<Stream> open)
        {
            try
            {
                using (var stream = open())
                {
                    var arrival = new Arrival(stream);
                    bool isFirst = true;
                    while (!arrival.IsWhole && !isDisposed)
                    {
                        arrival.Next();
                        var size = (UIntPtr)arrival.Count;
                        var scene = arrival.IsWhole ? Native.ultragray_load(arrival.Bytes, size) : Native.ultragray_load_part(arrival.Bytes, size);
                        if (scene.IsInvalid) throw new InvalidDataException(Native.Problem());
                        lock (exchange)
                        {
                            arrived?.Dispose();
                            arrived = scene;
                            if (isFirst) exchange.Pulse();
                            else exchange.Renew();
                            isFirst = false;
                        }
                    }
                }
            }
            catch (Exception error) // of the reading, or there is no libultragray
            {
                exchange.Tell(0, error.GetBaseException().Message);
                throw;
            }
        }

        void Render()
        {
            var matrix = new double[16];
            var arriving = new Frame();
            SceneHandle scene = null;
            ViewHandle view = null;
            long viewed = 0;
            while (true)
            {
                long asked, set;
                ProbePose pose;
                RenderSettings settings;
                lock (exchange)
                {
                    while (!isDisposed && (exchange.Asked == exchange.Answered || (scene == null && arrived == null))) Monitor.Wait(exchange);
                    if (isDisposed) break;
                    if (arrived != null)
                    {
                        scene?.Dispose();
                        scene = arrived;
                        arrived = null;
                    }
                    asked = exchange.Asked;
                    set = exchange.SetSince;
                    pose = exchange.Pose;
                    settings = exchange.Settings;
                }
                if (viewed != set)
                {
                    view?.Dispose();
                    view = Native.ultragray_prepare(scene, JsonWriter.Text(settings));
                    viewed = set;
                }
                if (!view.IsInvalid && Render(view, pose, asked, matrix, arriving)) exchange.Publish(asked, ref arriving);
                else exchange.Tell(asked, Native.Problem());
            }
            view?.Dispose();
            scene?.Dispose();
        }

        bool Render(ViewHandle view, ProbePose pose, long number, double[] matrix, Frame frame)
        {
            if (frame.View != view) // each of the frames that take turns, once for each view
            {
                frame.View = view;
                frame.Header = new FrameHeader();
                frame.Header.Extrapolation = new Extrapolation();
                frame.Header.Read(new JsonReader(Encoding.UTF8.GetBytes(Native.Text(Native.ultragray_view_info(view)))));
                frame.Count = (int)Native.ultragray_frame_bytes(view);
                frame.Reserve(frame.Count);
            }
            pose.CopyTo(matrix);
            frame.Header.Sequence = number;
            frame.SetPose(matrix);
            FrameExtrapolation told;
            if (Native.ultragray_render(view, matrix, (UIntPtr)1, threads, frame.Buffer, out told) != 0) return false;
            told.CopyTo(frame.Header.Extrapolation);
            return true;
        }

        sealed class SceneHandle : SafeHandle
        {
            public SceneHandle() : base(IntPtr.Zero, true)
            {
            }

            public override bool IsInvalid => handle == IntPtr.Zero;

            protected override bool ReleaseHandle()
            {
                Native.ultragray_free_scene(handle);
                return true;
            }
        }

        internal sealed class ViewHandle : SafeHandle
        {
            public ViewHandle() : base(IntPtr.Zero, true)
            {
            }

            public override bool IsInvalid => handle == IntPtr.Zero;

            protected override bool ReleaseHandle()
            {
                Native.ultragray_free_view(handle);
                return true;
            }
        }

        /// <summary>ultragray_extrapolation; NaN is not known.</summary>
        [StructLayout(LayoutKind.Sequential)]
        struct FrameExtrapolation
        {
            double distanceMm, angleDeg, confidence, supportedShare, contactShare, indentationMm, forceN;

            internal void CopyTo(Extrapolation it)
            {
                it.DistanceMm = Known(distanceMm);
                it.AngleDeg = Known(angleDeg);
                it.Confidence = Known(confidence);
                it.SupportedShare = Known(supportedShare);
                it.ContactShare = Known(contactShare);
                it.IndentationMm = Known(indentationMm);
                it.ForceN = Known(forceN);
            }

            static double? Known(double value) => double.IsNaN(value) ? null : (double?)value;
        }

        /// <summary>The functions of ultragray.h.</summary>
        static class Native
        {
            const string Library = "ultragray"; // libultragray.so, ultragray.dll

            [DllImport(Library)]
            internal static extern SceneHandle ultragray_load(byte[] bytes, UIntPtr size);

            [DllImport(Library)]
            internal static extern SceneHandle ultragray_load_part(byte[] bytes, UIntPtr size);

            [DllImport(Library)]
            internal static extern void ultragray_free_scene(IntPtr scene);

            [DllImport(Library)]
            internal static extern ViewHandle ultragray_prepare(SceneHandle scene, byte[] settings);

            [DllImport(Library)]
            internal static extern IntPtr ultragray_view_info(ViewHandle view);

            [DllImport(Library)]
            internal static extern UIntPtr ultragray_frame_bytes(ViewHandle view);

            [DllImport(Library)]
            internal static extern void ultragray_free_view(IntPtr view);

            [DllImport(Library)]
            internal static extern int ultragray_render(ViewHandle view, double[] poses, UIntPtr count, int threads, byte[] pixels, out FrameExtrapolation told);

            [DllImport(Library)]
            static extern IntPtr ultragray_problem();

            internal static string Problem()
            {
                return Text(ultragray_problem());
            }

            internal static string Text(IntPtr text)
            {
                return Marshal.PtrToStringUTF8(text);
            }
        }
    }
}
