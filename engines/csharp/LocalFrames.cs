using System;
using System.Runtime.InteropServices;
using System.Text;
using System.Threading;

namespace Ultragray
{
    /// <summary>
    /// Frames that this machine renders itself, by libultragray (ultragray.h): no service, no network. A thread of its own loads the
    /// scene and renders the newest pose.
    /// </summary>
    public sealed class LocalFrames : IFrameSource
    {
        readonly Exchange exchange = new Exchange();
        readonly Func<byte[]> read;
        readonly int threads;
        readonly Thread renderer;
        bool isDisposed;

        /// <summary>`read` gives the bytes of a scene file, such as () => File.ReadAllBytes("demo.ugr").</summary>
        public LocalFrames(Func<byte[]> read, RenderSettings settings = null, int threads = 1)
        {
            this.read = read;
            this.threads = threads;
            exchange.Set(settings);
            renderer = new Thread(Run) { IsBackground = true, Name = "ultragray" };
            renderer.Start();
        }

        public string Problem => exchange.Problem;

        public RenderSettings Settings
        {
            set { exchange.Set(value); }
        }

        public void Ask(ProbePose pose) => exchange.Ask(pose);

        public bool Take(ref Frame frame) => exchange.Take(ref frame);

        /// <summary>Ends it, without waiting: the thread frees the scene after the frame that it renders.</summary>
        public void Dispose()
        {
            lock (exchange) isDisposed = true;
            exchange.Pulse();
        }

        /// <summary>Waits until the thread has freed the scene, after Dispose.</summary>
        public void Join() => renderer.Join();

        void Run()
        {
            try
            {
                byte[] file = read();
                using (var scene = Native.ultragray_load(file, (UIntPtr)file.Length))
                {
                    if (scene.IsInvalid) exchange.Tell(0, Native.Problem());
                    else RenderAll(scene);
                }
            }
            catch (Exception error) // of the reading, or there is no libultragray
            {
                exchange.Tell(0, error.GetBaseException().Message);
            }
        }

        void RenderAll(SceneHandle scene)
        {
            var matrix = new double[16];
            var arriving = new Frame();
            ViewHandle view = null;
            long viewed = 0;
            while (true)
            {
                long asked, set;
                ProbePose pose;
                RenderSettings settings;
                lock (exchange)
                {
                    while (!isDisposed && exchange.Asked == exchange.Answered) Monitor.Wait(exchange);
                    if (isDisposed) break;
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
            double distanceMm, angleDeg, confidence, supportedShare, contactShare;

            internal void CopyTo(Extrapolation it)
            {
                it.DistanceMm = Known(distanceMm);
                it.AngleDeg = Known(angleDeg);
                it.Confidence = Known(confidence);
                it.SupportedShare = Known(supportedShare);
                it.ContactShare = Known(contactShare);
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
